"""What light costs in a pose: Gaussians of one avatar posed in even light, in the photo's, and in what the hand leaves.

Fills docs/avatar.md (lit-pose). The ways take turns in one run; on CUDA each is a graph of one call, replayed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch

from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.bench.timing import Probe, capture, device_clock, time_groups
from oasis_warp.core.types import Gaussians
from oasis_warp.data.photo import read_photo
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import rest_mesh
from oasis_warp.reconstruction import reconstruct
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import PHOTOS
from studies.tables import Column, Section, table

GROUPS, SECONDS = 40, 8.0


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"device", "poses"})

    threads: int | None = 2
    photo: Path = PHOTOS / "palm_flat_right_03.jpg"
    poses: tuple[str, ...] = ("fist", "open")


def ways(avatar: Avatar, pose: str) -> dict[str, Callable[[], Gaussians]]:
    """Ways to pose the avatar's Gaussians on its posed surface."""
    hand, rest, gaussians, light, *_ = avatar.parts
    assert light is not None and light.light.albedo is not None, "a photo has light"
    vertices = avatar.mesh(pose).vertices
    lights = {
        "even light": None,
        "the photo's light": light._replace(light=light.light._replace(albedo=None)),
        "what the hand leaves of it": light,
    }
    surface = rest_mesh(rest.vertices, hand.faces)
    return {
        name: lambda own=own: pose_gaussians(gaussians, hand.faces, surface, vertices, own)
        for name, own in lights.items()
    }


@torch.no_grad()
def measure_pose(pose: str, options: Options) -> list[Row]:
    """Milliseconds of each way in one pose."""
    avatar = reconstruct(read_photo(options.photo), options.config()).avatar
    calls = ways(avatar, pose)
    if options.device == "cuda":
        graphs = [capture(call) for call in calls.values()]
        probes = [Probe(graph.graph.replay, device_clock) for graph in graphs]
    else:
        probes = [Probe(call) for call in calls.values()]
    samples = time_groups(probes, GROUPS, SECONDS)
    device = f"{options.threads} threads" if options.device == "cpu" else torch.cuda.get_device_name()
    return [
        {"device": device, "pose": pose, "way": way, "ms": sample.median_ms, "gaussians": len(avatar.gaussians.colors)}
        for way, sample in zip(calls, samples, strict=True)
    ]


def run(options: Options) -> list[Row]:
    """Time every pose."""
    cases = {f"{pose} on {options.device}": (pose, options) for pose in options.poses}
    return measured("lit_pose", cases, measure_pose, options)


COLUMNS = (
    Column("device", "device"), Column("pose", "pose"), Column("light", "way"), Column("Gaussians", "gaussians", ",d"),
    Column("ms", "ms", ".3g"),
)  # fmt: skip
SECTIONS = (Section("avatar.md", "lit-pose", table(COLUMNS)),)
