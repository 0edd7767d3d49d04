"""`edit`: paint on the photo that an avatar was made from, and the avatar wears the paint. No estimator runs."""

import functools
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.repaint import NoPaintError, RepaintResult, find_paint, match_size, read_mask, repaint
from oasis_warp.adaptation.reprojection import Canvas
from oasis_warp.adaptation.sh_lighting import without_light
from oasis_warp.core.camera import crop_camera
from oasis_warp.core.config import BLACK, EditConfig, check_config
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent, timed_stage
from oasis_warp.core.mirror import mirror_camera, mirror_pose
from oasis_warp.core.processes import single_threaded_math
from oasis_warp.core.types import HandCrop, Photo
from oasis_warp.data.photo import as_photo
from oasis_warp.data.square_crop import Square, find_square, resample_square
from oasis_warp.hand.skinning import skin
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import masked_psnr
from oasis_warp.ops import warm_up

OTHER_PHOTO = 0.06
"""Median colour difference between avatar and photo from which this is not the photo that the avatar was made from, and
between a photo and the painted one from which one is no copy of the other."""
MUCH_LEFT_OUT = 0.25
"""Share of the paint on the hand that could not be used, from which it is worth a warning."""
PAINTED = 0.5
"""Share of paint from which a pixel is judged as paint."""


class Edit(NamedTuple):
    """An avatar with paint on it, and how it came about."""

    avatar: Avatar
    square: Square
    """The part of the painted picture that `image` and `mask` show: the avatar's source camera sees the same."""
    image: Float[Tensor, "S S 3"]
    """What was painted on."""
    mask: Float[Tensor, "S S"]
    """Share of each of its pixels that is paint."""
    stages: dict[str, float]
    """Seconds of each stage."""
    measures: dict[str, float]
    """painted_mm2, new_gaussians, n_gaussians, left_out_percent, input_psnr_db (inside the paint, against the painted
    picture), unchanged_psnr_db (elsewhere, against the picture before; infinite where that is the same bit for bit)."""
    warnings: tuple[str, ...]


@single_threaded_math()
@torch.no_grad()
def edit(
    avatar: Avatar,
    painted: Photo | Path | str,
    *,
    photo: Photo | Path | str | None = None,
    mask: Photo | Path | str | None = None,
    config: EditConfig = EditConfig(),  # noqa: B008 - frozen
    progress: Progress = silent,
) -> Edit:
    """Bring what was painted on an avatar's photo into the avatar.

    Shape, pose and camera are the avatar's own; where in the picture its camera looked is found by drawing it. Where
    there is paint, the Gaussians are replaced by finer ones, as many as the picture has pixels there; all others stay
    bit for bit.

    Args:
        avatar: From `reconstruct` or `Avatar.load`; it is not changed.
        painted: The photo with something painted on it, or its file: the whole of it, of any size. Or, where `photo` is
            given, a picture of the paint alone, with the rest transparent.
        photo: The photo before. What differs from it is paint, if no `mask` says so.
        mask: White, or opaque, where there is paint.
        config: Options.
        progress: Called as work goes on.

    Raises:
        InputError: neither `photo` nor `mask` is given, the pictures have different proportions, they show another
            hand, or there is no paint on it. Or a wrong file.
        TypeError: a picture is neither a photo nor a file.
    """
    check_config(config)
    painted = as_photo(painted, "painted")
    photo = None if photo is None else as_photo(photo)
    mask = None if mask is None else as_photo(mask, "mask")
    if photo is None and mask is None:
        raise InputError(
            f"{painted.name}: the paint cannot be told from the photo; also give the original photo, or a mask."
        )
    stages: dict[str, float] = {}
    stage = functools.partial(timed_stage, seconds=stages, progress=progress)
    with stage("kernels"):
        warm_up(avatar.device)
    with stage("difference"):
        image, before, paint = _compare(painted, photo, mask)
    with stage("registration"):
        square = _find_hand(avatar, before, (photo or painted).name)
    with stage("paint"):
        size = min(config.size, round(square.side))
        shown, share = (resample_square(plane, *square[:3], size).clamp(0, 1) for plane in (image, paint))
        canvas = _right_handed(avatar, shown, share, size)
        try:
            painting = _repaint(avatar, canvas, config.steps, progress)
        except NoPaintError as error:
            where = "on the hand" if mask else "on the hand that differs from the photo"
            message = f"{painted.name}: there is no paint {where}; paint on the hand, or give a mask."
            raise InputError(message) from error
    edited = avatar.with_looks(painting.gaussians, avatar.light)
    measures = _measure(avatar, edited, painting, canvas)
    return Edit(edited, square, shown, share, stages, measures, _warnings(painting.left_out))


def _warnings(left_out: float) -> tuple[str, ...]:
    if left_out < MUCH_LEFT_OUT:
        return ()
    return (
        f"{100 * left_out:.0f} % of the paint lies on a slant or beside an edge and was left out; paint where the "
        "photo shows the skin from the front.",
    )


def _compare(painted: Photo, photo: Photo | None, mask: Photo | None) -> tuple[Tensor, Tensor, Tensor]:
    """The painted picture, the same without paint (as far as it is known) and the share of paint."""
    image = painted.rgb.float() / 255
    height, width = image.shape[:2]
    before = image if photo is None else match_size(photo, width, height, painted.name)
    if mask is not None:
        paint = read_mask(mask, width, height)
    elif painted.alpha is not None and photo is not None and photo.alpha is None:
        paint = painted.alpha  # a layer of paint alone
    else:
        if photo is not None and float((image - before).abs().mean(-1).median()) > OTHER_PHOTO:
            raise InputError(
                f"{painted.name}: does not match {photo.name}; paint on a copy of that photo, or give a mask."
            )
        paint = find_paint(before, image)
    return image, before, paint


def _find_hand(avatar: Avatar, picture: Tensor, name: str) -> Square:
    drawn = avatar.render(avatar.source_camera, avatar.source_pose, BLACK)
    square = find_square(drawn.image.cpu(), drawn.alpha.cpu(), picture)
    if square.difference > OTHER_PHOTO:
        raise InputError(f"{name}: does not match the avatar; give the whole photo that the avatar was made from.")
    return square


def _right_handed(avatar: Avatar, image: Tensor, mask: Tensor, size: int) -> Canvas:
    """The canvas in the frame of the avatar's Gaussians: that of a left hand is mirrored."""
    source = avatar.source_camera
    camera = crop_camera(source, 0.0, 0.0, float(source.width), size)
    if avatar.side == "left":
        image, mask, camera = image.flip(1), mask.flip(1), mirror_camera(camera)
    return Canvas(image.to(avatar.device), mask.to(avatar.device), camera)


def _repaint(avatar: Avatar, canvas: Canvas, steps: int, progress: Progress) -> RepaintResult:
    """The avatar's Gaussians with the paint of `canvas`, which is taken off the avatar's light first."""
    pose = mirror_pose(avatar.source_pose) if avatar.side == "left" else avatar.source_pose
    posed = skin(avatar.hand, avatar.rest, pose)
    if avatar.light is not None:
        crop = HandCrop(*canvas[:2], torch.ones_like(canvas.mask), canvas.camera, avatar.rest, posed)
        canvas = canvas._replace(image=without_light(avatar.hand, crop, avatar.light).image)
    rest, faces = avatar.rest.vertices, avatar.hand.faces
    return repaint(avatar.gaussians, faces, rest, posed.vertices, canvas, steps=steps, progress=progress)


def _measure(before: Avatar, after: Avatar, painting: RepaintResult, canvas: Canvas) -> dict[str, float]:
    camera = mirror_camera(canvas.camera) if before.side == "left" else canvas.camera
    image, mask = (plane.flip(1) if before.side == "left" else plane for plane in canvas[:2])
    old, new = (avatar.render(camera, avatar.source_pose, BLACK) for avatar in (before, after))
    inside = ((mask > PAINTED) & (new.alpha > PAINTED)).to(image)
    return {
        "painted_mm2": 1e6 * painting.area,
        "new_gaussians": float(painting.n_new),
        "n_gaussians": float(len(painting.gaussians.opacities)),
        "left_out_percent": 100 * painting.left_out,
        "input_psnr_db": masked_psnr(new.image, image, inside),
        "unchanged_psnr_db": masked_psnr(new.image, old.image, (mask == 0).to(image)),
    }
