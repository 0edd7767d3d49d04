"""What Gaussians finer than a crop of 256 px are worth: likeness to the photo, size and time against the crop's side.

Fills docs/detail.md (detail). Likeness is measured away from outlines and above the wrist.
"""

import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from oasis_warp.avatar.observation import inner_mask
from oasis_warp.core.camera import crop_camera
from oasis_warp.core.config import BLACK
from oasis_warp.core.mirror import mirror_camera
from oasis_warp.core.types import HandCrop
from oasis_warp.estimation.hand_crop import crop_hand, detail_size
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from oasis_warp.ops import depth_map
from oasis_warp.reconstruction import Reconstruction, reconstruct
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import photo_named
from studies.tables import Column, Section, table

PLAIN, FAR = 256, 256
"""Sides of the crop that the others are compared with, and of the picture from afar [px]."""
SYNTHETIC_SIZE, FRAME_SIZE, FRAMES = 1280, 512, 9
RIM = 1 / 64
"""Share of the crop's side, at the outline, that is not judged."""


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"photos"})
    photos: tuple[str, ...] = ("back_flat_right_04.jpg",)
    """Photos of the tests, files, or synthetic:K; of the tests' photos none is as large as those."""
    sizes: tuple[int, ...] = (64, 128, 256, 512, 1024)
    """Sides of the crop [px]; 256 is one of them."""


def inside_outline(crop: HandCrop) -> Tensor:
    """Pixels away from the outlines of mask and surface and above the wrist.

    Between fingers that touch in the photo the surface may have a gap, which no Gaussian fills.
    """
    camera, faces = crop.camera, bundled_hand().faces
    seen = depth_map(crop.posed.vertices, faces, camera.viewmat, camera.K, camera.width, camera.height)
    hand = crop.mask * (seen.face_ids >= 0)
    return inner_mask(hand, max(1, round(RIM * len(hand)))) * crop.above_wrist > 0.5


@torch.no_grad()
def error(made: Reconstruction, crop: HandCrop) -> float:
    """PSNR against the photo, over black, `inside_outline` [dB]."""
    avatar, left = made.avatar, made.avatar.side == "left"
    image = avatar.render(mirror_camera(crop.camera) if left else crop.camera, avatar.source_pose, BLACK).image
    return masked_psnr(image.flip(1) if left else image, crop.image, inside_outline(crop).float())


def file_bytes(avatar: Avatar) -> int:
    """Size of the avatar's file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "avatar.safetensors"
        avatar.save(path)
        return path.stat().st_size


@torch.no_grad()
def frame_times(avatars: list[Avatar]) -> list[float]:
    """Fewest seconds of posing and drawing each avatar once, in turns."""
    best = [math.inf] * len(avatars)
    for _ in range(FRAMES):
        for k, avatar in enumerate(avatars):
            camera = crop_camera(avatar.source_camera, 0.0, 0.0, float(avatar.source_camera.width), FRAME_SIZE)
            start = time.perf_counter()
            avatar.render(camera, avatar.source_pose).image.sum().item()  # waits for a GPU
            best[k] = min(best[k], time.perf_counter() - start)
    return best


def measure(name: str, options: Options) -> list[Row]:
    """A row for each side of the crop."""
    config, sizes = options.config(), options.sizes
    photo = photo_named(name, size=SYNTHETIC_SIZE, device=config.device)
    made = {size: reconstruct(photo, replace(config, size=size, force=True)) for size in sizes}
    first = made[PLAIN]
    own_size = detail_size(first.fit, config)
    offsets = first.avatar.surface_offsets.cpu()
    close, far = (crop_hand(photo, first.fit, offsets, config, size) for size in (own_size, FAR))
    times = frame_times([each.avatar for each in made.values()])
    return [
        {
            "photo": Path(name).stem, "own_size": own_size, "size": size, "psnr_db": error(each, close),
            "psnr_far_db": error(each, far), "gaussians": len(each.avatar.gaussians.opacities),
            "file_mb": file_bytes(each.avatar) / 1e6, "frame": frame / times[sizes.index(PLAIN)],
            "detail_s": each.stages.get("detail", 0.0), "total_s": sum(each.stages.values()),
        }
        for (size, each), frame in zip(made.items(), times, strict=True)
    ]  # fmt: skip


def run(options: Options) -> list[Row]:
    """Measure every photo."""
    return measured("detail", {name: (name, options) for name in options.photos}, measure, options)


SECTIONS = (Section("detail.md", "detail", table((
    Column("photo", "photo"), Column("its own side, px", "own_size"), Column("size", "size"),
    Column("PSNR at its own side, dB", "psnr_db", ".1f"), Column("at 256 px, dB", "psnr_far_db", ".1f"),
    Column("Gaussians", "gaussians"), Column("file, MB", "file_mb", ".1f"),
    Column("frame, of that at 256", "frame", ".2f"), Column("detail, s", "detail_s", ".1f"),
    Column("in all, s", "total_s", ".0f"),
))),)  # fmt: skip
