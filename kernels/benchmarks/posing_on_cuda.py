"""Time what it takes to pose an avatar on a CUDA device: each operator and all of them, in graphs and from Python.

    python kernels/benchmarks/posing_on_cuda.py [--batch 1000]

The poses are checked first: those of the CPU within 1e-5, twice the same bits, and the same in a graph. Medians of
groups of calls, the rivals taking turns; times on the device by CUDA events, of graphs that hold ten calls. Last many
poses in one call, and the memory that takes.
"""

import argparse
import gc
import statistics
import time
from collections.abc import Callable

import torch

from oasis_warp import ops
from oasis_warp.avatar.anchors import place_anchors
from oasis_warp.core.types import Camera, HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.render.replay import CapturedGraph

GROUPS, CALLS = 11, 50


def avatar_on(device: str) -> Avatar:
    """The mean hand in one colour: 36,881 Gaussians."""
    hand = bundled_hand()
    shape = torch.zeros(len(hand.shape_names))
    anchors = place_anchors(hand, rest_hand(hand, shape))
    gaussians = anchors.with_colors(torch.full((len(anchors.opacities), 3), 0.5))
    pose = HandPose(named_pose(hand, "open"), torch.eye(3), torch.tensor([0.0, 0.0, 0.5]))
    return Avatar(
        side="left",
        shape=shape.to(device),
        surface_offsets=torch.zeros_like(hand.template).to(device),
        gaussians=type(gaussians)(*(part.to(device) for part in gaussians)),
        source_pose=pose,
        source_camera=Camera(torch.eye(4), torch.eye(3), 512, 512),
    )


def captured(call: Callable[[], object], times: int) -> torch.cuda.CUDAGraph:
    """A graph of so many calls."""
    call()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        for _ in range(times):
            call()
    return graph


def on_device(runs: dict[str, Callable[[], object]], calls: int = CALLS) -> dict[str, float]:
    """Median microseconds of each on the device."""
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for group in range(GROUPS + 2):
        for name, run in runs.items():
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            begin.record()
            for _ in range(calls):
                run()
            end.record()
            end.synchronize()
            if group >= 2:
                spent[name].append(1e3 * begin.elapsed_time(end) / calls)
    return {name: statistics.median(times) for name, times in spent.items()}


def on_host(runs: dict[str, Callable[[], object]], wait: bool) -> dict[str, float]:
    """Median microseconds a call takes Python, with or without waiting for the device after each."""
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for group in range(GROUPS + 2):
        for name, run in runs.items():
            torch.cuda.synchronize()
            begin = time.perf_counter()
            for _ in range(CALLS):
                run()
                if wait:
                    torch.cuda.synchronize()
            end = time.perf_counter()
            torch.cuda.synchronize()
            if group >= 2:
                spent[name].append(1e6 * (end - begin) / CALLS)
    return {name: statistics.median(times) for name, times in spent.items()}


def main() -> None:
    """Check, then measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--batch", type=int, default=1000)
    batch = parser.parse_args().batch
    torch.set_grad_enabled(False)
    here, there = avatar_on("cpu"), avatar_on("cuda")
    fist = HandPose(named_pose(here.hand, "fist"), torch.eye(3), torch.tensor([0.1, 0.2, 0.5]))
    static = HandPose(*(part.cuda() for part in fist))

    def pose() -> tuple[torch.Tensor, ...]:
        return there.pose(static, validate=False)[:3]

    want, got, again = here.pose(fist)[:3], pose(), pose()
    worst = max(float((a.cpu() - b).abs().max()) for a, b in zip(got, want, strict=True))
    assert worst < 1e-5, worst
    assert all(torch.equal(a, b) for a, b in zip(got, again, strict=True))
    recording = CapturedGraph(lambda *parts: there.pose(HandPose(*parts), validate=False)[:3], fist, there.shape)
    replayed = recording(fist)
    assert replayed is not None and all(torch.equal(a, b) for a, b in zip(got, replayed, strict=True))
    print(f"{len(got[0])} Gaussians, {len(there.hand.template)} vertices; against the CPU {worst:.1e}, the same bits")

    model, rest, faces = there._model, there._rest, there.hand.faces
    bones = ops.bone_transforms(*static, rest.joints, model.pose_axes, model.parents)
    correctives = {"displacements": model.corrective_basis, "strengths": bones.bends}
    posed = ops.skin(rest.vertices, None, model.weights, bones.transforms, **correctives).means
    turned = ops.face_rotations(there._rest_mesh, posed, faces)
    canonical = there._canonical
    riders = {
        "vertex_index": canonical.vertex_index, "offsets": canonical.offsets,
        "vertex_area_ratio": turned.vertex_area_ratio,
    }  # fmt: skip
    steps = {
        "bone_transforms": lambda: ops.bone_transforms(
            *static, rest.joints, model.pose_axes, model.parents, validate=False
        ),
        "skin": lambda: ops.skin(
            rest.vertices, None, model.weights, bones.transforms, validate=False, **correctives
        ),
        "skin, no correctives": lambda: ops.skin(
            rest.vertices, None, model.weights, bones.transforms, validate=False
        ),
        "face_rotations": lambda: ops.face_rotations(there._rest_mesh, posed, faces, validate=False),
        "face_rotations, from vertices": lambda: ops.face_rotations(rest.vertices, posed, faces, validate=False),
        "pose_on_mesh": lambda: ops.pose_on_mesh(
            posed, faces, canonical.face_index, canonical.barycentrics, turned.vertex_quats, turned.area_ratio,
            canonical.quats, canonical.scales, validate=False, **riders,
        ),
        "all": pose,
    }  # fmt: skip
    gc.disable()
    graphs = {name: captured(step, 10) for name, step in steps.items()}
    for name, spent in on_device({name: graph.replay for name, graph in graphs.items()}).items():
        print(f"in a graph: {name:32s} {spent / 10:8.2f} us")
    once = captured(pose, 1)
    print(f"in a graph of one: all {on_device({'all': once.replay})['all']:8.2f} us")
    calls = steps | {"CapturedGraph": lambda: recording(fist)}
    for wait in (False, True):
        for name, spent in on_host(calls, wait).items():
            print(f"from Python{', waiting' if wait else '':9s}: {name:32s} {spent:8.2f} us")

    many = HandPose(*(part.expand(batch, *part.shape).contiguous() for part in static))
    for _ in range(2):
        there.pose(many, validate=False)
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    spent = on_device({"batch": lambda: there.pose(many, validate=False)}, calls=1)["batch"]
    peak = torch.cuda.max_memory_allocated() / 2**30
    print(f"{batch} poses in one call: {spent / 1e3:.2f} ms, {spent / batch:.2f} us a pose; peak {peak:.2f} GiB")


if __name__ == "__main__":
    main()
