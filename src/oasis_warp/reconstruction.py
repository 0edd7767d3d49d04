"""`reconstruct`: one photo in, an avatar out. The only file that knows the order of the stages."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.adapt import adapt, detail_of
from oasis_warp.adaptation.sharpen import sharpen
from oasis_warp.avatar.anchors import PRIOR_SIZE, inset_offsets
from oasis_warp.avatar.densify import coarsen
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.prior import Prior
from oasis_warp.avatar.quality import SurfaceQuality, assess_surface, coverage_warnings, photo_warnings, shares
from oasis_warp.core.camera import crop_camera
from oasis_warp.core.config import BLACK, AdaptConfig, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent, timed_stage
from oasis_warp.core.mirror import as_right_hand, mirror_camera, mirror_pose
from oasis_warp.core.types import Camera, CanonicalGaussians, HandCrop, HandFit, HandLight, Landmarks, Photo, Render
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.estimation.fit_quality import keeps_quality, with_pose
from oasis_warp.estimation.keypoints import read_keypoints
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.refine import refine
from oasis_warp.estimation.surface_offsets import outline_offsets, rendered_outline_offsets
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from oasis_warp.network.prior import choose_prior
from oasis_warp.ops import warm_up

CROP_MARGIN = 1.12
"""Side of the crop over the longer extent of the mask."""
COARSE_SIZE = PRIOR_SIZE
"""Side of the crop that the prior reads and the whole hand is fitted to [px]: as many pixels as it has Gaussians. What
a larger one shows beyond it goes into finer Gaussians."""
SMALL_SIZE = 128
"""Side of the photo's own crop up to which a third of the Gaussians is as like the photo, or more so [px]."""
FINEST_SIZE = 1024
"""Side that is chosen for a photo at most [px]."""


class Reconstruction(NamedTuple):
    """An avatar and how it came about."""

    avatar: Avatar
    fit: HandFit
    """In the photo's own frame."""
    prior: Mapping[str, str | int]
    """Which prior was asked: its `about`."""
    stages: dict[str, float]
    """Seconds of each stage."""
    errors: dict[str, float]
    """What was measured: reprojection_percent, mask_iou, input_psnr_db, ..."""
    warnings: tuple[str, ...]
    """Of the fit, the photo and what it shows, in words; empty when nothing is doubtful."""
    quality: SurfaceQuality
    """How well each place of the surface is known."""


def reconstruct(
    photo: Photo,
    config: ReconstructConfig = ReconstructConfig(),  # noqa: B008 - frozen
    *,
    keypoints: Path | None = None,
    prior: Prior | None = None,
    progress: Progress = silent,
) -> Reconstruction:
    """Make an avatar of one hand of `photo`.

    Args:
        photo: From `oasis_warp.read_photo`.
        config: Options.
        keypoints: A JSON file with 21 landmarks, or with pose and camera, to use instead of the networks.
        prior: What to assume of a hand before its photo is fitted; the one that `config.prior` names when not given.
        progress: Called as work goes on.

    Raises:
        InputError: no such hand in the photo, a fit too poor to go on (see `ReconstructConfig.force`), a wrong file.
    """
    stages: dict[str, float] = {}

    def stage(name: str) -> AbstractContextManager[None]:
        return timed_stage(name, stages, progress)

    hand = bundled_hand()
    estimator = HandEstimator(hand)
    with stage("prior"):  # a wrong file is told before the long work, not after it
        prior = prior or choose_prior(config.prior, config.backbone_weights)
    with stage("landmarks"):
        given = read_keypoints(keypoints, photo) if keypoints else choose_hand(
            estimator.find(photo), config.hand, photo.name
        )  # fmt: skip
    with stage("fit"):
        fit = estimator.fit(photo, given, force=config.force) if isinstance(given, Landmarks) else given
    with stage("outline"):
        offsets = initial_offsets(hand, fit)
    with stage("kernels"):  # compiled only once there is a hand to draw
        warm_up(config.device)
    with stage("crop"):
        crop = crop_hand(photo, fit, offsets, config)
    with stage("prior"):
        guess = prior(crop)
    moved = 0.0
    if config.refine == "on" and isinstance(given, Landmarks):  # a pose that was given is right as it is
        with stage("refinement"):
            refinement = refine(hand, guess, crop, crop_landmarks(fit, crop.camera), native_size(fit))
            pose = refinement.pose
            found = with_pose(hand, fit, mirror_pose(pose) if fit.side == "left" else pose)
            if refinement.accepted and keeps_quality(found, fit):
                fit, moved = found, refinement.moved
                offsets = initial_offsets(hand, fit)
                crop = crop_hand(photo, fit, offsets, config)
                guess = prior(crop)
    with stage("outline"):
        offsets = refine_offsets(hand, [photo], [fit], offsets, [guess], config)
        crop = crop_hand(photo, fit, offsets, config)
    with stage("adaptation"):
        if is_low_resolution(config, fit):
            guess = coarsen(hand, guess, crop.rest)
        settings = AdaptConfig(light=config.light, texture_steps=config.steps, seed=config.seed)
        adaptation = adapt(hand, guess, crop, settings, progress)
    gaussians, close = adaptation.gaussians, crop
    light = adaptation.light
    if (size := finer_size(fit, config)) is not None:
        with stage("detail"):
            close = crop_hand(photo, fit, offsets, config, size)
            plain = detail_of(hand, gaussians, close, light)
            gaussians = sharpen(hand, gaussians, [plain], progress=progress).gaussians
    avatar = make_avatar(fit, offsets, crop, gaussians, light)
    with stage("quality"):
        quality = assess_surface(hand, crop, composite_over_photo(avatar, crop))
        shown = shares(hand, crop.rest.vertices, quality)
        doubts = (*coverage_warnings(shown), *photo_warnings(close.image, close.mask, crop_side(fit)))
        errors = {
            "reprojection_percent": fit.reprojection,
            "worst_point_percent": fit.worst_point,
            "mask_iou": fit.mask_iou,
            "refined_px": moved,
            **input_errors(avatar, close),
            **shown,
        }
    return Reconstruction(avatar, fit, prior.about, stages, errors, (*fit.warnings, *doubts), quality)


def initial_offsets(hand: HandModel, *fits: HandFit) -> Float[Tensor, "V 3"]:
    """From the fitted rest surface to the one that carries Gaussians [m]: onto the photos' outlines, then inwards.

    How far inwards is right for pictures as fine as the finest of the photos.
    """
    return outline_offsets(hand, *fits) + inset_offsets(hand, max(map(native_size, fits)))


def refine_offsets(
    hand: HandModel,
    photos: Sequence[Photo],
    fits: Sequence[HandFit],
    offsets: Float[Tensor, "V 3"],
    guesses: Sequence[CanonicalGaussians],
    config: ReconstructConfig,
) -> Float[Tensor, "V 3"]:
    """`offsets`, moved until the prior's guesses are drawn with the outlines of their photos [m]."""
    views = [
        crop_hand(photo, fit, offsets, config, detail_size(fit, config))
        for photo, fit in zip(photos, fits, strict=True)
    ]
    return offsets + rendered_outline_offsets(hand, guesses, views).cpu()


def native_size(fit: HandFit) -> int:
    """Side of the crop that shows all there is in the photo, within what is of use here [px]."""
    return min(max(round(crop_side(fit)), COARSE_SIZE), FINEST_SIZE)


def is_low_resolution(config: ReconstructConfig, *fits: HandFit) -> bool:
    """Whether all photos are so small that fewer Gaussians do; not when `config` asks for a size."""
    return config.size == "auto" and max(map(crop_side, fits)) <= SMALL_SIZE


def crop_side(fit: HandFit) -> float:
    """Of the square around the hand in the photo [px]."""
    return float(square_around(fit.mask, CROP_MARGIN)[2])


def crop_landmarks(fit: HandFit, crop: Camera) -> Float[Tensor, "21 2"]:
    """The fit's landmarks as the crop of its hand shows them [px]; those of a left hand are mirrored."""
    right, K = as_right_hand(fit), crop.K.cpu()
    own = right.camera.K
    return (right.landmarks.xy - own[:2, 2]) * K.diagonal()[:2] / own.diagonal()[:2] + K[:2, 2]


def detail_size(fit: HandFit, config: ReconstructConfig) -> int:
    """Side of the crop with all the detail that `config` asks for [px]."""
    return native_size(fit) if config.size == "auto" else config.size


def finer_size(fit: HandFit, config: ReconstructConfig) -> int | None:
    """Side of the crop whose detail goes into finer Gaussians [px]; None where the coarse ones do.

    In even light there is none: what the photo shows beyond the prior is not taken over as it is.
    """
    size = detail_size(fit, config)
    return size if config.light != "even" and size > COARSE_SIZE else None


def crop_hand(
    photo: Photo, fit: HandFit, offsets: torch.Tensor, config: ReconstructConfig, size: int | None = None
) -> HandCrop:
    """The square crop that avatars are fitted to, with the fitted surface in its camera; a left hand is mirrored.

    Its side is `size` [px], or else what `config` asks for, up to `COARSE_SIZE`.
    """
    hand = bundled_hand()
    if size is None:
        size = COARSE_SIZE if config.size == "auto" else min(config.size, COARSE_SIZE)
    image, right = photo.rgb.float() / 255, as_right_hand(fit)
    mask, camera = right.mask, right.camera
    if not bool((mask > 0.5).any()):
        raise InputError(f"{photo.name}: the mask of the hand is empty. Give --keypoints, or another photo.")
    above = torch.from_numpy(wrist_line(fit.landmarks.xy.numpy()).above_mask((camera.width, camera.height))).float()
    if fit.side == "left":
        image, above = image.flip(1), above.flip(1)
    left, top, side = square_around(mask, CROP_MARGIN)
    rest = rest_hand(hand, fit.shape)
    rest = rest._replace(vertices=rest.vertices + offsets)
    posed = skin(hand, rest, right.pose)
    crop = crop_camera(camera, left, top, side, size)
    device = torch.device(config.device)

    def there(nouns):
        return type(nouns)(*(part.to(device) for part in nouns))

    def cut(plane):
        return resample_square(plane.contiguous(), left, top, side, size).clamp(0, 1).to(device)

    return HandCrop(
        image=cut(image),
        mask=cut(mask),
        above_wrist=cut(above),
        camera=crop._replace(viewmat=crop.viewmat.to(device), K=crop.K.to(device)),
        rest=there(rest),
        posed=there(posed),
    )


def make_avatar(
    fit: HandFit,
    offsets: torch.Tensor,
    crop: HandCrop,
    gaussians: CanonicalGaussians,
    light: HandLight | None = None,
) -> Avatar:
    """The hand of `fit` with the looks of `gaussians` in `light`; `offsets` and `crop` are those of its making."""
    camera = crop.camera
    return Avatar(
        side=fit.side,
        shape=fit.shape.to(crop.image),
        surface_offsets=offsets.to(crop.image),
        gaussians=gaussians,
        source_pose=fit.pose,
        source_camera=mirror_camera(camera) if fit.side == "left" else camera,
        light=light,
    )


def _input_view(avatar: Avatar, crop: HandCrop) -> Render:
    """The avatar over black as `crop` shows the hand; a left hand is mirrored."""
    if avatar.side == "right":
        return avatar.render(crop.camera, avatar.source_pose, BLACK)
    image, alpha = avatar.render(mirror_camera(crop.camera), avatar.source_pose, BLACK)
    return Render(image.flip(1), alpha.flip(1))


@torch.no_grad()
def composite_over_photo(avatar: Avatar, crop: HandCrop) -> Float[Tensor, "S S 3"]:
    """The avatar drawn over its own photo."""
    image, alpha = _input_view(avatar, crop)
    return image + (1 - alpha)[..., None] * crop.image


@torch.no_grad()
def input_errors(avatar: Avatar, crop: HandCrop) -> dict[str, float]:
    """How well the avatar explains its own photo: over black, inside the mask above the wrist line, in the crop."""
    image, alpha = _input_view(avatar, crop)
    judged = crop.above_wrist > 0.5
    inside = ((crop.mask > 0.5) & judged).to(image)
    covered = (alpha > 0.5) & judged
    union = (covered | (inside > 0)).sum().clamp_min(1)
    return {
        "input_psnr_db": masked_psnr(image, crop.image, inside),
        "input_psnr_inner_db": masked_psnr(image, crop.image, inner_mask(inside)),
        "render_mask_iou": float((covered & (inside > 0)).sum() / union),
        "n_gaussians": float(len(avatar.gaussians.opacities)),
    }
