"""Pose an avatar and render it in a loop, as your own program would.

    python examples/pose_and_render.py --avatar out/avatar.safetensors
    python examples/pose_and_render.py --frames 48 --size 512 --device cuda

Without --avatar the bundled photo is reconstructed first. Closes the hand, turns the camera around it, writes one PNG
per frame, and prints the frames per second of posing and rendering.
"""

import time
from dataclasses import dataclass
from importlib.resources import as_file
from pathlib import Path

import torch
import tyro

from oasis_warp import Avatar, read_photo, reconstruct
from oasis_warp.assets import asset
from oasis_warp.data.pictures import to_uint8, write_picture


@dataclass(frozen=True, kw_only=True)
class Options:
    """Which avatar, and how many frames of which size."""

    avatar: Path | None = None
    frames: int = 8
    size: int = 256
    """Side of a frame [px]."""
    device: str = "cpu"
    out: Path = Path("frames")


def load(options: Options) -> Avatar:
    """The avatar of the file, or that of the bundled photo."""
    if options.avatar is not None:
        return Avatar.load(options.avatar, options.device)
    with as_file(asset("photos", "palm_open_left_02.png")) as bundled:
        avatar = reconstruct(read_photo(bundled)).avatar
    avatar.save(options.out / "avatar.safetensors")
    return Avatar.load(options.out / "avatar.safetensors", options.device)


def main(options: Options) -> None:
    """Load, then pose, render and write frame by frame."""
    options.out.mkdir(parents=True, exist_ok=True)
    avatar = load(options)
    first, last = (avatar.held(name).angles for name in ("open", "fist"))
    seconds = 0.0
    with torch.no_grad():
        for k in range(options.frames):
            share = k / max(options.frames - 1, 1)
            pose = avatar.source_pose._replace(angles=torch.lerp(first, last, share))
            camera = avatar.orbit_camera(pose, azimuth=1.5 * share, size=options.size)
            began = time.perf_counter()
            image = avatar.render(camera, pose).image.cpu()
            seconds += time.perf_counter() - began
            write_picture(options.out / f"{k:04d}.png", to_uint8(image))
    print(f"wrote {options.frames} frames to {options.out}, {options.frames / seconds:.0f} frames per second")


if __name__ == "__main__":
    main(tyro.cli(Options))
