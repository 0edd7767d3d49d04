"""`reconstruct` and `reconstruct_same_hand`: photos of one hand in, an avatar out; one photo is the case K = 1.

The only file that knows the order of the stages: see `_run`.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.adapt import Adaptation, adapt, add_detail
from oasis_warp.adaptation.fine_skin import COARSE, SPACING, cut_skin
from oasis_warp.adaptation.photo_view import match_photos
from oasis_warp.adaptation.rim_shade import limit_shade, match_rim
from oasis_warp.adaptation.smooth_shade import spread_shade
from oasis_warp.adaptation.unseen_skin import OwnSkin, PaintedSkin, paint_unseen
from oasis_warp.avatar.densify import coarsen
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.prior import Prior
from oasis_warp.avatar.quality import (
    SurfaceQuality,
    assess_surface,
    combine_quality,
    coverage_of_photos,
    coverage_percent,
    coverage_warnings,
    over_photo,
    photo_warnings,
)
from oasis_warp.avatar.wrist import ARM_STEP, close_wrist, end_shade
from oasis_warp.core import surface
from oasis_warp.core.config import ReconstructConfig, adapt_config
from oasis_warp.core.devices import check_run
from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent, timed_stage
from oasis_warp.core.mirror import mirror_pose
from oasis_warp.core.processes import single_threaded_math
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandFit, HandLight, Landmarks, Photo, Render
from oasis_warp.data.photo import as_photo
from oasis_warp.estimation.estimator import HandEstimator, check_sides, choose_hand, fit_together
from oasis_warp.estimation.fit_quality import keeps_quality, with_pose
from oasis_warp.estimation.hand_crop import (
    COARSE_SIZE,
    crop_hands,
    crop_landmarks,
    crop_side,
    initial_surfaces,
    is_low_resolution,
    native_size,
    refine_surfaces,
    resolutions,
)
from oasis_warp.estimation.keypoints import read_keypoints
from oasis_warp.estimation.refine import refine
from oasis_warp.fitted_avatar import draw_as_photo, make_avatar
from oasis_warp.hand.template import chosen_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import Perceptual, masked_psnr
from oasis_warp.network.heads import ColorHeads
from oasis_warp.network.prior import choose_prior, guess_with_heads
from oasis_warp.ops import warm_up

OTHER_LIGHT = 1.6
"""Times by which a photo is brighter or darker than the first, in any channel, from which it is worth a warning."""
NOTHING_NEW = 0.5
"""Share of the surface [%] that a photo must show better than all others, or it was not needed."""


class Reconstruction(NamedTuple):
    """An avatar of one photo and how it came about."""

    avatar: Avatar
    fit: HandFit
    """In the photo's own frame."""
    prior: Mapping[str, str | int]
    """`about` of the prior that was used."""
    stages: dict[str, float]
    """Seconds of each stage."""
    errors: dict[str, float]
    """What was measured: reprojection_percent, mask_iou, input_psnr_db, ..."""
    warnings: tuple[str, ...]
    """Warnings about the fit, the photo and what it shows; empty when nothing is doubtful."""
    quality: SurfaceQuality
    """How well each place of the surface is known."""
    skin: OwnSkin | None = None
    """Of what unseen skin was painted; None where none was."""


class PhotoOfHand(NamedTuple):
    """One of the photos and its part in the avatar."""

    name: str
    fit: HandFit
    """In the photo's own frame, with the shape that all photos share."""
    gain: tuple[float, float, float]
    """How much brighter it is than the first, channel by channel."""
    errors: dict[str, float]
    """As `Reconstruction.errors`, in the photo's own light; and of the surface [%] seen_percent, what it shows, and
    best_percent, what it shows better than the others."""
    light: HandLight | None
    """The photo's own light, in the frame of its camera; None where light is even or part of the colours."""


class FusedReconstruction(NamedTuple):
    """An avatar of several photos and how it came about."""

    avatar: Avatar
    """In the light of the first photo, whose pose and camera are its source."""
    photos: tuple[PhotoOfHand, ...]
    prior: Mapping[str, str | int]
    """`about` of the prior that was used."""
    stages: dict[str, float]
    """Seconds of each stage."""
    errors: dict[str, float]
    """What any of the photos shows of the surface: as `avatar.quality.coverage_percent`; n_gaussians."""
    warnings: tuple[str, ...]
    quality: SurfaceQuality
    """How well each place of the surface is known."""
    skin: OwnSkin | None = None
    """Of what unseen skin was painted; None where none was."""


Stage = Callable[[str], AbstractContextManager[None]]
"""Times the stage of that name."""


class _Outcome(NamedTuple):
    """Results of all stages for K photos."""

    fused: FusedReconstruction
    """Without warnings."""
    photo_warnings: list[list[str]]
    coverage_warnings: list[str]


def reconstruct(
    photo: Photo | Path | str,
    config: ReconstructConfig = ReconstructConfig(),  # noqa: B008 - frozen
    *,
    keypoints: Path | None = None,
    prior: Prior | None = None,
    perceptual: Perceptual | None = None,
    progress: Progress = silent,
) -> Reconstruction:
    """Make an avatar of one hand of `photo`.

    Args:
        photo: From `oasis_warp.read_photo`, or its file.
        config: Options.
        keypoints: A file with 21 landmarks, or with pose and camera, to use instead of the networks:
            `estimation.keypoints.read_keypoints`.
        prior: What to assume of a hand before its photo is fitted; the one that `config.prior` names when not given.
        perceptual: LPIPS (`losses.load_lpips`) on `config.device`, to be measured; with `config.adapt` "lora" it
            is in the loss too, as in the paper.
        progress: Called as work goes on.

    Raises:
        InputError: no such hand in the photo, a fit too poor to go on (see `ReconstructConfig.force`), a wrong file.
        TypeError: no photo.
    """
    check_run(config)  # before a file is read
    fused, (of_photo,), of_coverage = _run([as_photo(photo)], config, keypoints, prior, perceptual, progress)
    (own,) = fused.photos
    errors = {name: value for name, value in own.errors.items() if name != "best_percent"} | fused.errors
    warnings = (*own.fit.warnings, *of_coverage, *of_photo)
    return Reconstruction(
        fused.avatar, own.fit, fused.prior, fused.stages, errors, warnings, fused.quality, fused.skin
    )  # fmt: skip


def reconstruct_same_hand(
    photos: Sequence[Photo | Path | str],
    config: ReconstructConfig = ReconstructConfig(),  # noqa: B008 - frozen
    *,
    prior: Prior | None = None,
    perceptual: Perceptual | None = None,
    progress: Progress = silent,
) -> FusedReconstruction:
    """Make one avatar from several photos of one hand, in any poses.

    Args:
        photos: From `oasis_warp.read_photo`, or their files. The first decides on exposure and white balance, the
            source pose and the source camera. One photo alone gives the avatar of `reconstruct`; shading of several is
            evened out.
        config: Options, for every photo.
        prior: What to assume of a hand before its photos are fitted; the one that `config.prior` names when not given.
        perceptual: As `reconstruct`.
        progress: Called as work goes on.

    Raises:
        TypeError: one alone, or one that is none.
        ValueError: no photo.
        InputError: a photo without such a hand, with a hand of the other side, or with a fit too poor to go on (see
            `ReconstructConfig.force`); the message names it. Or a wrong file.
    """
    if isinstance(photos, Photo | Path | str):
        raise TypeError(f"photos: expected a list, got one {type(photos).__name__}; put it in brackets, [photo].")
    if not (photos := list(photos)):
        raise ValueError("photos: expected at least one, got none. Read them with oasis_warp.read_photo.")
    check_run(config)
    fused, of_photos, of_coverage = _run([*map(as_photo, photos)], config, None, prior, perceptual, progress)
    return fused._replace(warnings=(*_name_warnings(fused.photos, of_photos), *of_coverage))


@single_threaded_math()
@torch.enable_grad()  # whatever the caller has
def _run(
    photos: Sequence[Photo], config: ReconstructConfig, keypoints: Path | None, prior: Prior | None,
    perceptual: Perceptual | None, progress: Progress,
) -> _Outcome:  # fmt: skip
    """All stages, in their order. `keypoints` are those of a single photo."""
    if config.adapt == "lora" and len(photos) > 1:
        raise InputError(f"adapt lora: works with one photo, got {len(photos)}; leave it out for several photos.")
    stages: dict[str, float] = {}
    stage = functools.partial(timed_stage, seconds=stages, progress=progress)
    hand = chosen_hand(config.hand_model, config.mano_dir)
    with stage("prior"):  # first, because a wrong file must fail before the long work
        prior = prior or choose_prior(config.prior, config.backbone_weights)
    found, fits = _fit(hand, photos, config, keypoints, stage, progress)
    with stage("outline"):
        surfaces = initial_surfaces(hand, fits)
    with stage("kernels"):  # compiled only once there is a hand to draw
        warm_up(config.device)
    with stage("crop"):
        crops = crop_hands(photos, fits, surfaces, config)
    with stage("prior"):
        guesses, heads = _guess(prior, crops, config)
    moved = [0.0] * len(photos)
    if config.refine == "on" and isinstance(found[0], Landmarks):  # a given pose is right as it is
        with stage("refinement"):
            fits, moved = _refine_fits(hand, guesses, crops, fits)
            if any(moved):
                surfaces = initial_surfaces(hand, fits)
                crops = crop_hands(photos, fits, surfaces, config)
                guesses, heads = _guess(prior, crops, config)
    with stage("outline"):
        surfaces = refine_surfaces(hand, photos, fits, surfaces, guesses, config)
        crops = crop_hands(photos, fits, surfaces, config)
        close = crop_hands(photos, fits, surfaces, config, finer=True)
        scales, close_scales = resolutions(fits, crops), resolutions(fits, close)
    with stage("adaptation"):
        if is_low_resolution(config, *fits) and heads is None:
            guesses = [coarsen(hand, guess, crops[0].rest) for guess in guesses]
        adaptation = adapt(
            hand, guesses, crops, adapt_config(config), resolutions=scales, heads=heads,
            perceptual=None if heads is None else perceptual, progress=progress,
        )  # fmt: skip
    with stage("detail"):
        adaptation = add_detail(hand, adaptation, close, close_scales, COARSE_SIZE, progress)
    adaptation, painted = _finish(hand, adaptation, crops, close, config, stage)
    invented, skin = (None, None) if painted is None else (painted.invented, painted.skin)
    gaussians, light = adaptation.gaussians, adaptation.light
    avatar = make_avatar(fits[0], surfaces.shared, crops[0], gaussians, light, invented, hand=hand)
    with stage("quality"):
        areas = surface.vertex_areas(crops[0].rest.vertices, hand.faces.to(config.device))
        views = zip(fits, surfaces.own, crops, close, strict=True)
        judged = [_assess(hand, adaptation, k, *view, perceptual) for k, view in enumerate(views)]
        quality = combine_quality([own for own, _ in judged])._replace(invented=invented)
        coverage = coverage_percent(hand, areas, quality)
        shares = coverage_of_photos(areas, adaptation.observations.confidence, adaptation.observations.share)
        warnings = [photo_warnings(c.image, c.mask, crop_side(fit)) for c, fit in zip(close, fits, strict=True)]
    measured = [{"refined_px": px} | errors | own for px, (_, errors), own in zip(moved, judged, shares, strict=True)]
    lights = adaptation.lights or [None] * len(photos)
    about = tuple(map(PhotoOfHand, [p.name for p in photos], fits, _tuples(adaptation.gains), measured, lights))
    coverage["n_gaussians"] = float(len(avatar.gaussians.opacities))
    fused = FusedReconstruction(avatar, about, prior.about, stages, coverage, (), quality, skin)
    return _Outcome(fused, warnings, coverage_warnings(coverage))


def _fit(
    hand: HandModel,
    photos: Sequence[Photo],
    config: ReconstructConfig,
    keypoints: Path | None,
    stage: Stage,
    progress: Progress,
) -> tuple[list[Landmarks | HandFit], list[HandFit]]:
    """The landmarks that are found in each photo, or given, and the fits of one hand to all photos."""
    estimator = HandEstimator(hand, config.device)
    with stage("landmarks"):
        found = [
            read_keypoints(keypoints, p, hand=hand, which=config.hand)
            if keypoints
            else choose_hand(estimator.find(p), config.hand, p.name)
            for p in photos
        ]
        check_sides(photos, found)
    with stage("fit"):
        return found, fit_together(estimator, photos, found, force=config.force, progress=progress)


def _finish(
    hand: HandModel, adaptation: Adaptation, crops: Sequence[HandCrop], close: Sequence[HandCrop],
    config: ReconstructConfig, stage: Stage,
) -> tuple[Adaptation, PaintedSkin | None]:  # fmt: skip
    """Paint what no photo shows, match the photos' views and close the wrist: the adaptation, and what was painted."""
    gaussians, painted, first, spacing = adaptation.gaussians, None, crops[0], ARM_STEP
    if config.unseen == "painted":
        with stage("painting"):
            spacing = COARSE if config.size != "auto" and config.size <= COARSE_SIZE else SPACING
            gaussians = cut_skin(hand, gaussians, close, adaptation.trusted.confidence.amax(0), spacing)
            painted = paint_unseen(hand, gaussians, adaptation.guess, first, adaptation.trusted, seed=config.seed)
            gaussians = painted.gaussians
    rest, lights = first.rest.vertices, adaptation.lights
    if lights is not None:
        with stage("detail"):
            gaussians = limit_shade(hand, gaussians, crops, lights[0])
            gaussians, spread = spread_shade(hand, gaussians, first, lights[0])
            lights = (match_rim(hand, gaussians, first, spread), *lights[1:])
            lights = tuple(end_shade(hand, light, rest) for light in lights)
            gaussians = match_photos(hand, gaussians, close, lights, adaptation.gains)
    with stage("wrist"):
        closed = close_wrist(hand, gaussians, rest, min(spacing, ARM_STEP), seed=config.seed)
    return adaptation._replace(gaussians=closed, lights=lights), painted


def _guess(
    prior: Prior, crops: Sequence[HandCrop], config: ReconstructConfig
) -> tuple[list[CanonicalGaussians], ColorHeads | None]:
    """The guess of each photo. With "lora" and "full" there is one, and its colour heads come with it to be trained."""
    if config.adapt == "field":
        return [prior(crop) for crop in crops], None
    guess, heads = guess_with_heads(prior, crops[0])
    return [guess], heads


def _tuples(gains: Float[Tensor, "K 3"]) -> list[tuple[float, float, float]]:
    return [(red, green, blue) for red, green, blue in gains.tolist()]


def _refine_fits(
    hand: HandModel, guesses: Sequence[CanonicalGaussians], crops: Sequence[HandCrop], fits: Sequence[HandFit]
) -> tuple[list[HandFit], list[float]]:
    """Fits in the poses that explain their photos best, and how far each hand moved [px]; 0 where that was rejected."""
    refined, moved = [], []
    for guess, crop, fit in zip(guesses, crops, fits, strict=True):
        found = refine(hand, guess, crop, crop_landmarks(fit, crop.camera), native_size(fit))
        candidate = with_pose(hand, fit, mirror_pose(found.pose) if fit.side == "left" else found.pose)
        accepted = found.accepted and keeps_quality(candidate, fit)
        refined.append(candidate if accepted else fit)
        moved.append(found.moved if accepted else 0.0)
    return refined, moved


def _assess(
    hand: HandModel, adaptation: Adaptation, k: int, fit: HandFit, offsets: Float[Tensor, "V 3"], crop: HandCrop,
    close: HandCrop, perceptual: Perceptual | None,
) -> tuple[SurfaceQuality, dict[str, float]]:  # fmt: skip
    """How well photo k is explained, in its own light and on the surface that it was read on."""
    gaussians = adaptation.gaussians
    as_bright = gaussians._replace(colors=(gaussians.colors * adaptation.gains[k]).clamp(0, 1))
    light = adaptation.lights[k] if adaptation.lights else None
    avatar = make_avatar(fit, offsets, crop, as_bright, light, hand=hand)
    drawn, near = draw_as_photo(avatar, crop, fit.pose), draw_as_photo(avatar, close, fit.pose)
    errors = {
        "reprojection_percent": fit.reprojection,
        "worst_point_percent": fit.worst_point,
        "mask_iou": fit.mask_iou,
        **input_errors(near, close, perceptual),
    }
    return assess_surface(hand, crop, over_photo(drawn, crop)), errors


def input_errors(drawn: Render, crop: HandCrop, perceptual: Perceptual | None = None) -> dict[str, float]:
    """Errors of an avatar against its photo, inside the mask above the wrist; it was `drawn` over black."""
    image, alpha = drawn
    judged = crop.above_wrist > 0.5
    inside = ((crop.mask > 0.5) & judged).to(image)
    covered = (alpha > 0.5) & judged
    union = (covered | (inside > 0)).sum().clamp_min(1)
    errors = {
        "input_psnr_db": masked_psnr(image, crop.image, inside),
        "input_psnr_inner_db": masked_psnr(image, crop.image, inner_mask(inside)),
        "render_mask_iou": float((covered & (inside > 0)).sum() / union),
    }
    if perceptual is not None:
        errors["input_lpips"] = float(perceptual(image[None], crop.image[None], inside[None]))
    return errors


def _name_warnings(photos: Sequence[PhotoOfHand], warnings: Sequence[Sequence[str]]) -> list[str]:
    """Warnings of the fits, the photos and their differences; each begins with the photo's name."""
    messages = [
        f"{photo.name}: {warning}"
        for photo, own in zip(photos, warnings, strict=True)
        for warning in (*photo.fit.warnings, *own)
    ]
    for photo in photos[1:]:
        factor = max(photo.gain, key=lambda gain: max(gain, 1 / gain))
        if max(factor, 1 / factor) > OTHER_LIGHT:
            how = f"{factor:.1f} times as bright as" if factor > 1 else f"{1 / factor:.1f} times darker than"
            messages.append(f"{photo.name}: its light is another, {how} {photos[0].name}; its colours may not fit in")
        if photo.errors["best_percent"] < NOTHING_NEW:
            messages.append(f"{photo.name}: adds next to nothing, other photos show all of it as well or better")
    return messages
