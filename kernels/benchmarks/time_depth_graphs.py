"""Depth maps and visibility of the bundled hand on CUDA, as nodes of a graph and as plain calls.

    python kernels/benchmarks/time_depth_graphs.py [sizes]

For each picture size: microseconds a call of a graph that holds ten of them (median of groups of replays, the cases
taking turns) and of the host for a call outside (minimum), and once what each kernel takes. Ids are checked against
the plain float64 kernels before anything is timed.
"""

import gc
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from oasis_warp.core.camera import orbit_camera
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import depth_map, depth_visibility

CALLS, REPLAYS, GROUPS = 10, 20, 9
SIZES = (224, 448, 1024, 4096)


def cases(size: int) -> dict[str, Callable[[], Any]]:
    """Calls to be timed."""
    hand = bundled_hand()
    camera = orbit_camera(hand.template, azimuth=0.4, elevation=0.2, size=size)
    vertices, faces = hand.template.cuda(), hand.faces.cuda()
    viewmat, K, known = camera.viewmat.cuda(), camera.K.cuda(), torch.arange(len(vertices), device="cuda")
    mesh, leaf = (vertices, faces, viewmat, K, size, size), vertices.clone().requires_grad_()
    points = (vertices, faces, K, viewmat, size, size)
    weights = torch.linspace(-1, 1, len(vertices), device="cuda")

    def gradient() -> Any:
        seen = depth_visibility(leaf, leaf, *points[1:], maps=False, validate=False).visibility
        return torch.autograd.grad(seen, leaf, weights)

    got, want = depth_map(*mesh), depth_map(*(t.double() if t.is_floating_point() else t for t in mesh[:4]), size, size)
    assert torch.equal(got.face_ids, want.face_ids)
    return {
        "ids": lambda: depth_map(*mesh, outputs=("face_ids",), validate=False),
        "ids, depth": lambda: depth_map(*mesh, outputs=("face_ids", "depth"), validate=False),
        "ids, depth, barycentrics": lambda: depth_map(*mesh, validate=False),
        "visibility": lambda: depth_visibility(
            vertices, *points, point_vertices=known, maps=False, validate=False
        ),
        "visibility, maps": lambda: depth_visibility(vertices, *points, point_vertices=known, validate=False),
        "visibility, both gradients": gradient,
    }  # fmt: skip


def graph_of(call: Callable[[], Any]) -> tuple[torch.cuda.CUDAGraph, list[Any]]:
    """A graph of `CALLS` calls, and what they return."""
    call()
    torch.cuda.synchronize()
    graph, kept = torch.cuda.CUDAGraph(), []
    with torch.cuda.graph(graph):
        kept.extend(call() for _ in range(CALLS))
    return graph, kept


def gpu_microseconds(graph: torch.cuda.CUDAGraph) -> float:
    """Of one call, over `REPLAYS` replays."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    for _ in range(REPLAYS):
        graph.replay()
    end.record()
    torch.cuda.synchronize()
    return 1e3 * start.elapsed_time(end) / (REPLAYS * CALLS)


def host_microseconds(call: Callable[[], Any]) -> float:
    """Until a call returns."""
    best = float("inf")
    for _ in range(200):
        torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - start)
    return 1e6 * best


def kernel_microseconds(call: Callable[[], Any]) -> dict[str, float]:
    """Of each kernel of a call, on average."""
    with profile(activities=[ProfilerActivity.CUDA]) as seen:
        for _ in range(20):
            call()
        torch.cuda.synchronize()
    return {event.key[:40]: event.device_time_total / 20 for event in seen.key_averages()}


def main() -> None:
    """Time all sizes given on the command line."""
    gc.disable()
    for size in [int(size) for size in sys.argv[1:]] or SIZES:
        calls = cases(size)
        graphs = {name: graph_of(call) for name, call in calls.items()}
        for _ in range(20):
            for graph, _ in graphs.values():
                graph.replay()
        groups = [{name: gpu_microseconds(graph) for name, (graph, _) in graphs.items()} for _ in range(GROUPS)]
        for name, call in calls.items():
            gpu = statistics.median(group[name] for group in groups)
            print(f"{size:5d}^2  {name:28s} graph {gpu:9.2f} us   host {host_microseconds(call):7.1f} us", flush=True)
        for name in ("visibility, maps", "visibility, both gradients"):
            for kernel, taken in kernel_microseconds(calls[name]).items():
                print(f"{size:5d}^2  {name:28s} {kernel:40s} {taken:9.2f} us", flush=True)
        del graphs


if __name__ == "__main__":
    main()
