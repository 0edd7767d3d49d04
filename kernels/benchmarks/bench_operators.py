"""Time every operator on the bundled hand: 37k Gaussians, 12k vertices, 25k faces.

    python kernels/benchmarks/bench_operators.py --device cpu --threads 1 --size 256

One JSON line an operator: median and quartiles of the wall time of a synchronised call, after warming up. Two ways to
the same picture are compared first; a wrong answer ends the run. Compare lines of one run only: machines drift.
"""

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable

import torch
import warp

from oasis_warp.avatar.anchors import place_anchors, vertex_to_gaussians
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.types import HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import blend_colors, blend_weights, depth_map, depth_visibility, face_rotations, rasterization
from oasis_warp.render.cameras import orbit_camera

WARM_UP, REPEATS = 5, 30
PALM_TO_CAMERA = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def measure(call: Callable[[], object], device: torch.device) -> dict[str, float]:
    """Milliseconds: median and quartiles."""
    times = []
    for k in range(WARM_UP + REPEATS):
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        if k >= WARM_UP:
            times.append(1e3 * (time.perf_counter() - start))
    low, middle, high = statistics.quantiles(times, n=4)
    return {"median_ms": round(middle, 3), "quartile_low_ms": round(low, 3), "quartile_high_ms": round(high, 3)}


def main() -> None:
    """Print a line an operator."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--size", type=int, default=256, help="side of the picture [px]")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    device, size = torch.device(options.device), options.size

    hand = bundled_hand().to(device)
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names), device=device))
    place = torch.tensor([0.0, 0.0, 0.5], device=device)
    posed = skin(hand, rest, HandPose(named_pose(hand, "open"), PALM_TO_CAMERA.to(device), place)).vertices
    anchors = place_anchors(hand, rest)
    canonical = anchors.with_colors(vertex_to_gaussians(torch.rand_like(rest.vertices), hand.faces, anchors))
    camera = orbit_camera(posed, 0.0, size=size)
    gaussians = pose_gaussians(canonical, hand.faces, rest.vertices, posed)
    geometry = gaussians[:4]
    learned = [part.clone().requires_grad_(True) for part in gaussians]

    def draw(parts=gaussians) -> torch.Tensor:
        image, _, _ = rasterization(*parts, camera.viewmat[None], camera.K[None], size, size)
        return image[0]

    def draw_and_back() -> None:
        draw(learned).sum().backward()

    weights = blend_weights(*geometry, camera.viewmat, camera.K, size, size)
    torch.testing.assert_close(blend_colors(weights, gaussians.colors), draw(), atol=2e-5, rtol=0)

    calls = {
        "rasterization forward": draw,
        "rasterization forward + backward": draw_and_back,
        "blend_weights": lambda: blend_weights(*geometry, camera.viewmat, camera.K, size, size),
        "blend_colors": lambda: blend_colors(weights, gaussians.colors),
        "depth_map": lambda: depth_map(posed, hand.faces, camera.viewmat, camera.K, size, size),
        "depth_visibility": lambda: depth_visibility(
            posed, posed, hand.faces, camera.K, camera.viewmat, size, size
        ),
        "face_rotations": lambda: face_rotations(rest.vertices, posed, hand.faces),
        "pose_gaussians": lambda: pose_gaussians(canonical, hand.faces, rest.vertices, posed),
    }
    about = {
        "device": torch.cuda.get_device_name() if device.type == "cuda" else platform.machine(),
        "threads": options.threads, "size": size, "gaussians": len(gaussians.means), "torch": torch.__version__,
        "warp": warp.__version__, "repeats": REPEATS,
    }  # fmt: skip
    for name, call in calls.items():
        print(json.dumps({"operator": name, **measure(call, device), **about}), flush=True)


if __name__ == "__main__":
    main()
