"""How long the learned prior takes to load and to encode one photo, and how much memory.

    python studies/time_prior.py --threads 2 --json out/prior_cpu.json
    python studies/time_prior.py --device cuda --json out/prior_cuda.json

Hand, sizes and precision are those of `oasis reconstruct`; what is on the photo does not change the time. CPU seconds
are those of all threads together; with one thread they tell its time where other work goes on beside it.
"""

import argparse
import json
import resource
import statistics
import time
from pathlib import Path

import torch

from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.types import HandCrop, HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.prior import NetworkPrior, choose_prior

WARM_UP = 3
SIZE = 256
"""Side of the crop [px]; the default of `oasis reconstruct`."""


def evidence_on(device: torch.device) -> HandCrop:
    """An open hand in front of noise."""
    hand = bundled_hand().to(device)
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names), device=device))
    orientation = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], device=device)  # palm to the camera
    pose = HandPose(named_pose(hand, "open"), orientation, torch.tensor([0.0, 0, 0.5], device=device))
    posed = skin(hand, rest, pose)
    image = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0)).to(device)
    mask = torch.ones(SIZE, SIZE, device=device)
    return HandCrop(image, mask, mask, orbit_camera(posed.vertices, 0.0, size=SIZE), rest, posed)


def measure(which: str | Path, device: torch.device, repeats: int) -> dict[str, object]:
    """Seconds and memory."""

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    bundled_hand()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start, busy = now(), time.process_time()
    prior = choose_prior(which)  # pyright: ignore[reportArgumentType] - a word or a path
    if not isinstance(prior, NetworkPrior):
        raise SystemExit(f"{which}: expected a network, got the prior {prior.about['name']!r}.")
    loading, loading_busy = now() - start, time.process_time() - busy
    crop = evidence_on(device)
    for _ in range(WARM_UP):
        prior(crop)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    times, cpu_times = [], []
    for _ in range(repeats):
        start, busy = now(), time.process_time()
        prior(crop)
        times.append(now() - start)
        cpu_times.append(time.process_time() - busy)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "prior": dict(prior.about),
        "device": torch.cuda.get_device_name() if device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads",
        "torch": torch.__version__,
        "load_seconds": loading,
        "load_cpu_seconds": loading_busy,
        "encode_seconds_fastest": min(times),
        "encode_seconds_median": statistics.median(times),
        "encode_cpu_seconds_fastest": min(cpu_times),
        "process_gib": peak / 2**20,
        "grown_gib": (peak - before) / 2**20,
        "device_gib": torch.cuda.max_memory_allocated() / 2**30 if device.type == "cuda" else None,
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prior", type=Path, help="weights file; the bundled one when not given")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    found = measure(options.prior or "learned", torch.device(options.device), options.repeats)
    text = json.dumps(found, indent=2)
    print(text)
    if options.json is not None:
        options.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
