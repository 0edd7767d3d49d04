"""What files of `oasis export` lose: sizes, times, places and pictures, read back by independent readers.

Fills docs/export.md (splats, meshes). The readers are those of the tests, written from the formats' specifications.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np
import torch
from scipy.spatial import cKDTree
from tests.export.splat_readers import READERS, play, read_gltf, read_harmonics
from torch import Tensor

from oasis_warp.assets import asset
from oasis_warp.core.camera import camera_center, orbit_camera
from oasis_warp.core.config import BLACK
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, Gaussians, HandPose
from oasis_warp.data.photo import read_photo
from oasis_warp.export import export_avatar, texture
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import photo_axes, posed_splats
from oasis_warp.export.surface_mesh import mesh_points, topology
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import skin_surface
from oasis_warp.hand.webxr_rig import TO_WEBXR
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import masked_psnr
from oasis_warp.ops import depth_map, spherical_harmonics
from oasis_warp.reconstruction import reconstruct
from oasis_warp.render import render
from studies.harness import Row, StudyOptions, measured
from studies.tables import Column, Section, power, table

PHOTO = "palm_open_left_02.png"
AZIMUTHS = tuple(math.radians(k) for k in (0, 70, 180, 290))
"""Views that pictures are compared in; the photo's is the first."""
RANDOM_POSES = 12
"""Beside the named ones, with angles within the joints' limits."""
COVERED = 0.99
"""Share of a pixel that is hand, from which textures are judged."""
MOST = 120.0
"""What `masked_psnr` says of pictures that are the same but for rounding [dB]."""
MESHES = (".glb", ".gltf", ".obj")
OTHERS = (".json",)


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    avatar: Path | None = None
    """Avatar file; that of the README's photo when not given."""
    size: int = 512
    """Side of the pictures [px]."""
    repeats: int = 3
    """Times that each file is written; the median counts."""
    seed: int = 0
    """Seed of the random poses."""


def the_avatar(options: Options) -> Avatar:
    """The avatar that is exported, kept below the options' folder."""
    path = options.avatar or options.out / "exports" / "avatar.safetensors"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        reconstruct(read_photo(asset("photos", PHOTO))).avatar.save(path)
    return Avatar.load(path)


def views(points: Tensor, size: int) -> list[Camera]:
    """Cameras around points whose y is up."""
    flipped = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    around = (orbit_camera(points @ flipped[:3, :3], azimuth, size=size) for azimuth in AZIMUTHS)
    return [camera._replace(viewmat=camera.viewmat @ flipped) for camera in around]


def write(avatar: Avatar, ending: str, options: Options, folder: Path) -> Row:
    """Size and processor's time of a file; of the kernels' loading none."""
    export_avatar(avatar, folder / f"hand{ending}")
    seconds = []
    for _ in range(options.repeats):
        start = time.process_time()
        export_avatar(avatar, folder / f"hand{ending}")
        seconds.append(time.process_time() - start)
    size = sum(file.stat().st_size for file in folder.iterdir())
    return {"ending": ending, "megabytes": size / 1e6, "seconds": median(seconds)}


@torch.no_grad()
def measure_splats(ending: str, options: Options) -> Row:
    """A file of Gaussians: what its means and pictures differ by from those that were written.

    Colours are those seen from the photo's side, but in a .ply, which has them from all sides.
    """
    avatar = the_avatar(options)
    with TemporaryDirectory() as name:
        path = Path(name) / f"hand{ending}"
        row = write(avatar, ending, options, Path(name))
        read = Gaussians(*(torch.from_numpy(np.array(p, np.float32)) for p in READERS[ending](path)))
        harmonics = read_harmonics(path) if ending == ".ply" else None
    true = posed_splats(ExportRequest(avatar))
    off = cKDTree(true.means.numpy()).query(read.means.numpy())[0].max()
    worst = math.inf
    for camera in views(true.means, options.size):
        if harmonics is not None:
            read = read._replace(colors=seen_colors(harmonics, read.means, camera))
            true = true._replace(colors=avatar.pose(avatar.source_pose, camera=in_world(camera, avatar)).colors)
        drawn, expected = (render(gaussians, camera, background=BLACK) for gaussians in (read, true))
        worst = min(worst, masked_psnr(drawn.image, expected.image, ((drawn.alpha + expected.alpha) > 0).float()))
    return {**row, "gaussians": len(read.means), "off_um": 1e6 * float(off), "psnr": worst}


def seen_colors(harmonics: Tensor, means: Tensor, camera: Camera) -> Tensor:
    """Colours of Gaussians from `camera`, as 3DGS draws them; y of the means is up, that of the harmonics down."""
    y_down = means.new_tensor([1.0, -1.0, -1.0])
    directions = (means - camera_center(camera.viewmat)) * y_down
    return (0.5 + spherical_harmonics(3, directions, harmonics)).clamp_min(0)


def in_world(camera: Camera, avatar: Avatar) -> Camera:
    """A camera among exported Gaussians in the world of the avatar."""
    axes, wrist = photo_axes(avatar.source_camera), avatar.mesh(avatar.source_pose).joints[0]
    moved = torch.eye(4)
    moved[:3, :3], moved[:3, 3] = axes, -axes @ wrist
    return camera._replace(viewmat=camera.viewmat @ moved)


@torch.no_grad()
def measure_mesh(ending: str, options: Options) -> Row:
    """A mesh: of a .glb also how far its vertices are from our own skinning."""
    avatar = the_avatar(options)
    with TemporaryDirectory() as name:
        row = {**write(avatar, ending, options, Path(name)), "psnr": texture_psnr(avatar, options.size)}
        return row if ending != ".glb" else {**row, **skinning_errors(avatar, Path(name) / f"hand{ending}", options)}


def sampled_angles(hand: HandModel, seed: int) -> list[Tensor]:
    """The named poses, then random ones: each angle between half of its limits."""
    generator = torch.Generator().manual_seed(seed)
    limits = hand.pose_limits[1:] / 2
    random = [
        limits[..., 0] + torch.rand(15, 3, generator=generator) * (limits[..., 1] - limits[..., 0])
        for _ in range(RANDOM_POSES)
    ]
    return [*(named_pose(hand, name) for name in POSE_NAMES if name != "rest"), *random]


def skinning_errors(avatar: Avatar, path: Path, options: Options) -> Row:
    """Distances [mm] of vertices from our own skinning, for readers of eight influences and of four."""
    mesh, turn = topology(avatar), torch.tensor(TO_WEBXR[avatar.side]).float()
    size, texture.SIZE = texture.SIZE, 64  # which is not looked at
    away: dict[int, list[np.ndarray]] = {1: [], 2: []}
    try:
        for angles in sampled_angles(avatar.hand, options.seed):
            pose = HandPose(angles, torch.eye(3), torch.zeros(3))
            export_avatar(avatar, path, pose=pose)
            document, binary = read_gltf(path)
            true = (mesh_points(skin_surface(*avatar.parts[:2], pose), avatar.hand, mesh) @ turn.T).numpy()[:-1]
            for sets, found in away.items():
                points = play(document, binary, document["nodes"], document["meshes"][0]["weights"], sets)
                found.append(np.linalg.norm(points[:-1] - true, axis=1))
    finally:
        texture.SIZE = size
    four = np.concatenate(away[1]) * 1e3
    return {"eight_mm": float(np.max(away[2]) * 1e3), "four_mm": float(four.mean()), "four_worst_mm": float(four.max())}


def texture_psnr(avatar: Avatar, size: int) -> float:
    """PSNR [dB] of the textured mesh, unlit, against the Gaussians in even light, over pixels of hand, worst view."""
    request = ExportRequest(avatar, light="none")
    picture = texture.bake_texture(request, "none", texture.SIZE).float() / 255
    splats, mesh = posed_splats(request), topology(avatar)
    pose = avatar.source_pose
    turn = torch.diag(torch.tensor([1.0, -1, -1])) @ avatar.source_camera.viewmat[:3, :3]
    posed = avatar.mesh(pose)
    points = (mesh_points(posed.vertices, avatar.hand, mesh) - posed.joints[0]) @ turn.T
    worst = math.inf
    for camera in views(splats.means, size):
        expected = render(splats, camera, background=BLACK)
        seen = depth_map(points, mesh.faces, camera.viewmat, camera.K, size, size)
        uv = (mesh.uv[mesh.faces[seen.face_ids.long()]] * seen.barycentrics[..., None]).sum(-2)
        grid = 2 * torch.stack([uv[..., 0], 1 - uv[..., 1]], -1) - 1
        drawn = torch.nn.functional.grid_sample(picture.permute(2, 0, 1)[None], grid[None], align_corners=False)[0]
        mask = (seen.face_ids >= 0) & (expected.alpha > COVERED)
        worst = min(worst, masked_psnr(drawn.permute(1, 2, 0), expected.image, mask.float()))
    return worst


def measure_format(ending: str, options: Options) -> Iterator[Row]:
    """The row of one format."""
    if ending in OTHERS:
        with TemporaryDirectory() as name:
            yield write(the_avatar(options), ending, options, Path(name))
        return
    yield (measure_splats if ending in READERS else measure_mesh)(ending, options)


def run(options: Options) -> list[Row]:
    """Measure every format that needs no further package."""
    endings = [*READERS, *MESHES, *OTHERS]
    return measured("exports", {ending: (ending, options) for ending in endings}, measure_format, options)


COMMON = (
    Column("ending", lambda row: f"`{row['ending']}`"), Column("MB", "megabytes", ".2f"),
    Column("CPU s", "seconds", ".1f"),
)  # fmt: skip
SPLATS = (
    *COMMON, Column("means off by, µm, at most", "off_um", ".1f"),
    Column("drawn again, dB, worst of 4 views", "psnr", lambda value: f"{value:.1f}" if value < MOST else "alike"),
)  # fmt: skip
MESH = (
    *COMMON, Column("texture against Gaussians, dB", "psnr", ".1f"),
    Column("vertices in 20 poses off by, mm, at most", "eight_mm", power),
    Column("with four influences: mean", "four_mm", ".2f"), Column("at most", "four_worst_mm", ".1f"),
)  # fmt: skip
SECTIONS = (
    Section("export.md", "splats", table(SPLATS, lambda rows: [row for row in rows if "off_um" in row])),
    Section("export.md", "meshes", table(MESH, lambda rows: [row for row in rows if "off_um" not in row])),
)
