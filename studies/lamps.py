"""What a lamp that casts sharp shadows would explain of photos beyond nine harmonics and a partly hidden sky.

Fills docs/avatar.md (lamps).
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import vertex_colors
from oasis_warp.avatar.sky import arriving, harmonic_basis
from oasis_warp.avatar.vertex_light import GAMMA
from oasis_warp.core.types import PosedHand
from oasis_warp.ops import depth_visibility
from oasis_warp.synthetic.illumination import look_at
from oasis_warp.synthetic.view_and_light import sphere
from studies.harness import AvatarOptions, Row, measured
from studies.hollows import seen_skin
from studies.inputs import PHOTOS, photos_below
from studies.tables import Column, Section, complete, percentiles, table

DISTANCE, BUFFER = 40.0, 192
"""Distance of a lamp over the hand's radius, and side of its depth buffer [px]."""
MARGIN = 0.003
"""Depth behind the nearest surface up to which skin is lit [m]."""
LEAST = 1e-6
"""Added to the squares of the terms, whose sum is about 1."""
LAMPS = ("a lamp without shadows", "a lamp with shadows")


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    photos: Path = PHOTOS / "same_hand"
    """Folder of photos; those of left hands are left out."""
    every: int = 4
    """Every so manieth photo is measured."""
    directions: int = 60
    """Directions of the lamp, evenly over the sphere; the best one of each photo counts."""


def lit_share(posed: PosedHand, faces: Tensor, directions: Float[Tensor, "D 3"]) -> Float[Tensor, "D V"]:
    """Share of a far lamp in each direction that reaches each vertex past the hand."""
    vertices = posed.vertices
    center = vertices.mean(0)
    radius = (vertices - center).norm(dim=1).max()
    focal = BUFFER / 2 * DISTANCE / 1.1
    K = torch.tensor([[focal, 0, BUFFER / 2], [0, focal, BUFFER / 2], [0, 0, 1]])
    own = torch.arange(len(vertices))
    return torch.stack([
        depth_visibility(
            vertices, vertices, faces, K, look_at(center + DISTANCE * radius * direction, center), BUFFER, BUFFER,
            margin=MARGIN, point_vertices=own, validate=False,
        ).visibility
        for direction in directions
    ])  # fmt: skip


def error_left(terms: Float[Tensor, "3 V K"], goal: Float[Tensor, "3 V"], weight: Float[Tensor, "V"]) -> float:
    """Sum of squares that the best combination of terms leaves; infinite for a lamp that takes light."""
    weighted = terms * weight[:, None]
    normal = weighted.mT @ terms + LEAST * torch.eye(terms.shape[-1])  # a lamp may light nothing that is seen
    found = torch.linalg.solve(normal, weighted.mT @ goal[..., None])
    left = float((weight * (goal - (terms @ found)[..., 0]).square()).sum())
    return left if terms.shape[-1] == 9 or float(found[:, 9:].mean()) > 0 else math.inf


def measure_photo(path: Path, options: Options) -> list[Row]:
    """What is left of the squared error of harmonics with the best lamp."""
    found = seen_skin(path, options.config())
    if found is None:
        return []
    avatar, _, mean_albedo, posed, seen, normals, exposure = found
    albedo = vertex_colors(avatar.gaussians, len(posed.vertices)) ** GAMMA
    scale = (seen.confidence[:, None] * albedo.square()).sum(0).sqrt()
    goal = (seen.colors.clamp(0, 1) ** GAMMA / scale).T
    sky = albedo * arriving(exposure[..., 1:], mean_albedo) / scale
    harmonics = harmonic_basis(normals, 9) * sky.T[..., None]
    alone = error_left(harmonics, goal, seen.confidence)
    directions = torch.from_numpy(sphere(options.directions)).to(normals)
    facing = (normals @ directions.T).clamp_min(0).T
    row: Row = {"harmonics": alone}
    shares = torch.ones_like(facing), lit_share(posed, avatar.hand.faces, directions)
    for name, share in zip(LAMPS, shares, strict=True):
        lamps = (facing * share)[..., None] * albedo / scale
        errors = [error_left(torch.cat([harmonics, lamp.T[..., None]], 2), goal, seen.confidence) for lamp in lamps]
        row[name] = min(*errors, alone) / alone
    return [row]


def run(options: Options) -> list[Row]:
    """Measure every photo."""
    paths = photos_below(options.photos)[:: options.every]
    cases = {path.relative_to(options.photos).as_posix(): (path, options) for path in paths}
    return measured("lamps", cases, measure_photo, options)


def lines(rows: list[Row]) -> list[Row]:
    """Percentiles over photos of the share of the squared error that is left."""
    own = complete(rows)
    return [
        {"light": f"nine harmonics and {name}", "photos": len(own),
         **dict(zip(("low", "middle", "high"), percentiles([row[name] for row in own]), strict=True))}
        for name in LAMPS
    ] if own else []  # fmt: skip


SECTIONS = (
    Section("avatar.md", "lamps", table(
        (
            Column("light", "light"), Column("photos", "photos"), Column("10 %", "low", ".2f"),
            Column("median", "middle", ".2f"), Column("90 %", "high", ".2f"),
        ),
        lines,
    )),
)  # fmt: skip
