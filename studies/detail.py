"""What Gaussians finer than a crop of 256 px are worth, and what fewer of them cost where the photo is small.

Fills docs/detail.md: "detail" (likeness away from outlines and above the wrist, size and time against the side of the
crop), "count" (avatars of scaled-down photos with Gaussians on vertices and faces, and on vertices alone, compared with
the photo at its own size and with each other in other poses). It also prints how many Gaussians never count for more
than so much of any pixel. `--sheet` draws docs/_static/detail.jpg instead: photo and avatars around some landmarks.
"""

import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.avatar.densify import coarsen
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.cli.summary import Panel, make_sheet, panel_side
from oasis_warp.core.camera import crop_camera, orbit_camera, project
from oasis_warp.core.config import BLACK, AdaptConfig, ReconstructConfig
from oasis_warp.core.mirror import mirror_camera
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.core.types import Camera, HandCrop
from oasis_warp.data.pictures import to_uint8
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.estimation.hand_crop import CROP_MARGIN, crop_hand, crop_side, detail_size, initial_offsets
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from oasis_warp.ops import depth_map
from oasis_warp.reconstruction import Reconstruction, input_errors, make_avatar, reconstruct
from oasis_warp.render.render import view_weights
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import fit_largest, photo_named, prior_named, scaled
from studies.tables import Column, Section, table, write_jpeg

PLAIN, FAR = 256, 256
"""Sides of the crop that the others are compared with, and of the picture from afar [px]."""
SYNTHETIC_SIZE, FRAME_SIZE, FRAMES = 1280, 512, 9
RIM = 1 / 64
"""Share of the crop's side, at the outline, that is not judged."""
POSES, VIEWS = ("open", "fist", "point"), 4
LEAST = (1 / 255, 0.02, 0.05)
UNSEEN_SIZE, UNSEEN_VIEWS, ELEVATIONS = 384, 8, (-0.9, 0.0, 0.9)
CLOSE = (
    ("synthetic:2", 12, "nail"), ("synthetic:7", 10, "creases"), ("back_flat_right_04.jpg", 10, "knuckle"),
    ("back_flat_right_04.jpg", 12, "nail"),
)  # fmt: skip
"""Photo, landmark in the middle and name of each row of the sheet."""
CLOSE_SHARE, SHEET_WIDTH = 0.17, 1000
TURNED = 0.7
"""Angle of the last panel of a row [rad]: the finer part must not show its border."""


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"parts", "photos", "small_photos", "sheet"})
    parts: tuple[Literal["detail", "count"], ...] = ("detail", "count")
    photos: tuple[str, ...] = ("back_flat_right_04.jpg",)
    """For "detail": photos of the tests, files, or synthetic:K; of the tests' photos none is as large as those."""
    small_photos: tuple[str, ...] = ("back_flat_right_04.jpg", "palm_open_left_02.png")
    """For "count"."""
    sizes: tuple[int, ...] = (64, 128, 256, 512, 1024)
    """Sides of the crop, for "detail" [px]; 256 is one of them."""
    small_sizes: tuple[int, ...] = (64, 96, 128, 192)
    """Sides of the square around the hand that photos are scaled down to, for "count" [px]."""
    sheet: Path | None = None
    """JPEG to draw instead."""


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


def measure_detail(name: str, sizes: tuple[int, ...], config: ReconstructConfig) -> list[Row]:
    """A row for each side of the crop."""
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


@torch.no_grad()
def likeness(avatar: Avatar, other: Avatar, size: int) -> tuple[float, float]:
    """PSNR of `other` in other poses from all around [dB], and how much more area it covers."""
    errors, areas = [], []
    for name in POSES:
        pose = avatar.source_pose._replace(angles=named_pose(avatar.hand, name))
        for k in range(VIEWS):
            camera = orbit_camera(avatar.mesh(pose).vertices, 2 * math.pi * k / VIEWS, 0.3, size)
            one, two = (each.render(camera, pose, BLACK) for each in (avatar, other))
            errors.append(10 ** (-masked_psnr(two.image, one.image, (one.alpha > 0.5).float()) / 10))
            areas.append(float(two.alpha.sum() / one.alpha.sum()) - 1)
    return -10 * math.log10(sum(errors) / len(errors)), sum(areas) / len(areas)


@torch.no_grad()
def largest_weights(avatar: Avatar) -> Float[Tensor, "N"]:
    """The largest weight of each Gaussian in any pixel, in all named poses from all around."""
    most = torch.zeros(len(avatar.gaussians.opacities))
    for name in POSE_NAMES:
        pose = avatar.source_pose._replace(angles=named_pose(avatar.hand, name))
        posed, vertices = avatar.pose(pose), avatar.mesh(pose).vertices
        for k in range(UNSEEN_VIEWS):
            for elevation in ELEVATIONS:
                camera = orbit_camera(vertices, 2 * math.pi * k / UNSEEN_VIEWS, elevation, UNSEEN_SIZE)
                by_gaussian = view_weights(posed, camera).transpose
                rows = torch.repeat_interleave(torch.arange(len(most)), by_gaussian.crow_indices().long().diff())
                most.scatter_reduce_(0, rows, by_gaussian.values(), "amax")
    return most


def measure_count(name: str, options: Options) -> Iterator[Row]:
    """A row for each size of the photo, and one of unseen Gaussians."""
    hand, large, avatars = bundled_hand(), photo_named(name, size=SYNTHETIC_SIZE), []
    side = crop_side(fit_largest(large))
    for size in options.small_sizes:
        photo = scaled(large, size / side)
        fit = fit_largest(photo)
        offsets = initial_offsets(hand, fit)
        crop = crop_hand(photo, fit, offsets, ReconstructConfig(force=True))
        own = crop_hand(photo, fit, offsets, ReconstructConfig(size=round(crop_side(fit))))
        guess, config = prior_named(options.prior)(crop), AdaptConfig(texture_steps=options.steps)
        adapted = (adapt(hand, [each], [crop], config) for each in (guess, coarsen(hand, guess, crop.rest)))
        avatars = [make_avatar(fit, offsets, crop, each.gaussians, each.light) for each in adapted]
        psnr, fewer_psnr = (input_errors(avatar, own)["input_psnr_inner_db"] for avatar in avatars)
        (far, _), (near, area) = likeness(*avatars, FAR), likeness(*avatars, FRAME_SIZE)
        frame, fewer_frame = frame_times(avatars)
        counts, files = [len(avatar.gaussians.opacities) for avatar in avatars], [file_bytes(a) / 1e6 for a in avatars]
        yield {
            "photo": Path(name).stem, "own_side": len(own.image), "psnr_db": psnr, "fewer_psnr_db": fewer_psnr,
            "far_db": far, "near_db": near, "area": area, "count": counts[0], "fewer": counts[1], "file_mb": files[0],
            "fewer_mb": files[1], "frame": fewer_frame / frame,
        }  # fmt: skip
    most = largest_weights(avatars[0])
    yield {"photo": Path(name).stem, "total": len(most), "unseen": [int((most < least).sum()) for least in LEAST]}


def run(options: Options) -> list[Row]:
    """Measure, or draw the sheet."""
    rows: list[Row] = []
    if options.sheet is not None:
        draw_sheet(options.config(), options.sheet)
        return rows
    if "detail" in options.parts:
        cases = {name: (name, options.sizes, options.config()) for name in options.photos}
        rows += measured("detail", cases, measure_detail, options)
    if "count" in options.parts:
        cases = {f"{name}, scaled down": (name, options) for name in options.small_photos}
        rows += measured("detail", cases, measure_count, options)
    return rows


def draw_sheet(config: ReconstructConfig, path: Path) -> None:
    """Photo, avatar of 256 px and of the photo's own size, and the latter from the side, around some landmarks."""
    rows, known, pixels = [], {}, panel_side(4, SHEET_WIDTH)
    for name, landmark, words in CLOSE:
        if name not in known:
            photo = photo_named(name, size=SYNTHETIC_SIZE, device=config.device)
            known[name] = photo, *(reconstruct(photo, replace(config, size=size)) for size in (PLAIN, "auto"))
        photo, plain, fine = known[name]
        fit, size = fine.fit, detail_size(fine.fit, config)
        _, _, side = square_around(fit.mask, CROP_MARGIN)
        xy, side = fit.landmarks.xy[landmark], CLOSE_SHARE * side
        square = float(xy[0]) - side / 2, float(xy[1]) - side / 2, side
        camera = crop_camera(fit.camera, *square, pixels)
        shown = to_uint8(resample_square(photo.rgb.float() / 255, *square, pixels)).numpy()
        panels = [Panel(shown, f"{words}: photo, {size} px")]
        for made, view, caption in (
            (plain, camera, "avatar, 256 px"), (fine, camera, f"avatar, {size} px"),
            (fine, turned_about(fine, xy, camera), "from beside"),
        ):  # fmt: skip
            panels.append(Panel(to_uint8(made.avatar.render(view, fit.pose).image).cpu().numpy(), caption))
        rows.append(panels)
    write_jpeg(path, make_sheet("Detail", "before and after, and from beside", rows, SHEET_WIDTH))


def turned_about(made: Reconstruction, xy: Tensor, camera: Camera) -> Camera:
    """`camera`, turned by `TURNED` about the place of the surface that the photo shows at `xy` [px]."""
    vertices = made.avatar.mesh(made.fit.pose).vertices.cpu()
    uv, _ = project(made.fit.camera, vertices)
    hidden = made.quality.visibility.cpu() == 0
    middle = vertices[((uv - xy).norm(dim=1) + 1e6 * hidden).argmin()]
    rotation = from_axis_angle(torch.tensor([0.0, 1.0, 0.0]), torch.tensor(TURNED))
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, middle - rotation @ middle
    return camera._replace(viewmat=viewmat @ camera.viewmat.cpu())


SECTIONS = (
    Section("detail.md", "detail", table(
        (
            Column("photo", "photo"), Column("its own side, px", "own_size"), Column("size", "size"),
            Column("PSNR at its own side, dB", "psnr_db", ".1f"), Column("at 256 px, dB", "psnr_far_db", ".1f"),
            Column("Gaussians", "gaussians"), Column("file, MB", "file_mb", ".1f"),
            Column("frame, of that at 256", "frame", ".2f"), Column("detail, s", "detail_s", ".1f"),
            Column("in all, s", "total_s", ".0f"),
        ),
        lambda rows: [row for row in rows if "size" in row],
    )),
    Section("detail.md", "count", table(
        (
            Column("photo", "photo"), Column("its own side, px", "own_side"), Column("likeness, dB", "psnr_db", ".1f"),
            Column("with fewer", "fewer_psnr_db", ".1f"), Column("fewer against all, 256 px", "far_db", ".1f"),
            Column("512 px", "near_db", ".1f"), Column("area, 512 px", lambda row: f"{100 * row['area']:+.1f} %"),
            Column("Gaussians", "count"), Column("fewer", "fewer"), Column("file, MB", "file_mb", ".1f"),
            Column("fewer", "fewer_mb", ".1f"), Column("frame", "frame", ".2f"),
        ),
        lambda rows: [row for row in rows if "own_side" in row],
    )),
    Section(None, "unseen", table(
        (
            Column("photo", "photo"), Column("Gaussians", "total", ","),
            *(
                Column(f"never above {least:.3f}", lambda row, k=k: row["unseen"][k], ",")
                for k, least in enumerate(LEAST)
            ),
        ),
        lambda rows: [row for row in rows if "unseen" in row],
    )),
)  # fmt: skip
