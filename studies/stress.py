"""What becomes of avatars of damaged photos.

Fills docs/detail.md (stress): likeness of each avatar to its own, damaged photo, inside the outline; likeness of its
open hand, from the photo's side and from behind, after one gain per channel, to the avatar of the undamaged photo; what
was refused without `force`, and what is newly warned about.
"""

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch

from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import BLACK, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.evaluation.metrics import match_colors
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from oasis_warp.reconstruction import Reconstruction, reconstruct
from studies.damage import DAMAGES, DamagedInput
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import photo_named
from studies.tables import Column, Section, table

VIEW_SIZE = 256
LARGEST = 0.05
"""Standard deviation beyond which a Gaussian has exploded [m]."""


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"photos"})
    photos: tuple[str, ...] = ("palm_open_left_02.png",)
    """Photos of the tests, files, or synthetic:K."""


def make(damaged: DamagedInput, config: ReconstructConfig, *, force: bool) -> Reconstruction:
    """Reconstruct a damaged photo."""
    with tempfile.TemporaryDirectory() as folder:
        keypoints = damaged.write_keypoints(Path(folder))
        return reconstruct(damaged.photo, replace(config, force=force), keypoints=keypoints)


def is_sane(gaussians: CanonicalGaussians) -> bool:
    """Whether every number is finite, every colour in [0, 1] and no Gaussian larger than `LARGEST`."""
    finite = all(bool(part.isfinite().all()) for part in gaussians if part is not None)
    colors = gaussians.colors
    return finite and bool(((colors >= 0) & (colors <= 1)).all()) and float(gaussians.scales.max()) < LARGEST


@torch.no_grad()
def likeness(avatar: Avatar, other: Avatar) -> float:
    """PSNR of two avatars' open hands, from the front and from behind, where both are, after one gain per channel [dB].

    An avatar takes the light of its photo, so a lamp of another colour is no damage in itself.
    """
    drawn = []
    for each in (avatar, other):
        pose = avatar.source_pose._replace(angles=named_pose(each.hand, "open"))
        vertices = each.mesh(pose).vertices
        cameras = (orbit_camera(vertices, azimuth, size=VIEW_SIZE) for azimuth in (0.0, math.pi))
        drawn.append([each.render(camera, pose, BLACK) for camera in cameras])
    images, others = (torch.cat([view.image for view in views]) for views in drawn)
    inside = torch.cat([(a.alpha > 0.99) & (b.alpha > 0.99) for a, b in zip(*drawn, strict=True)])
    return masked_psnr(match_colors(others, images, inside.float()), images, inside.float())


def measure(name: str, config: ReconstructConfig) -> list[Row]:
    """A row for the photo as it is and one for each damage."""
    photo = photo_named(name, device=config.device)
    base = reconstruct(photo, config)
    rows = [row_of(name, "none", base, base, "")]
    for title, damage in DAMAGES.items():
        damaged, refused = damage(photo, base), ""
        try:
            made = make(damaged, config, force=False)
        except InputError as error:
            refused = str(error)
            try:
                made = make(damaged, config, force=True)
            except InputError as final:
                rows.append({"photo": name, "damage": title, "refusal": f"even by force: {final}"})
                continue
        rows.append(row_of(name, title, made, base, refused))
    return rows


def row_of(name: str, damage: str, made: Reconstruction, base: Reconstruction, refused: str) -> Row:
    """What is measured of one avatar."""
    return {
        "photo": name, "damage": damage, "refusal": refused, "own_db": made.errors["input_psnr_inner_db"],
        "like_db": None if made is base else likeness(base.avatar, made.avatar),
        "mask_iou": made.errors["mask_iou"], "seen": made.errors["seen_percent"],
        "sane": is_sane(made.avatar.gaussians),
        "warnings": [warning for warning in made.warnings if damage == "none" or warning not in base.warnings],
    }  # fmt: skip


def run(options: Options) -> list[Row]:
    """Damage every photo."""
    return measured("stress", {name: (name, options.config()) for name in options.photos}, measure, options)


def said(row: Row) -> str:
    """Refusal, warnings and whether the avatar is broken, in words."""
    refusal = [f"refused: {row['refusal'].split(': ', 1)[-1]}"] if row["refusal"] else []
    broken = [] if row.get("sane", True) else ["**not finite or exploded**"]
    return "; ".join([*refusal, *row.get("warnings", []), *broken])


COLUMNS = (
    Column("damage", "damage"), Column("own photo, dB", "own_db", ".1f"),
    Column("undamaged avatar, dB", "like_db", ".1f"), Column("overlap of fit and mask", "mask_iou", ".2f"),
    Column("seen, %", "seen", ".0f"), Column("said", said),
)  # fmt: skip
SECTIONS = (Section("detail.md", "stress", table(COLUMNS)),)
