"""`reconstruct_same_hand`: several photos of one hand in, one avatar out."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.fuse import Fusion, add_detail, fuse
from oasis_warp.adaptation.reliability import VertexObservations
from oasis_warp.avatar.densify import coarsen
from oasis_warp.avatar.prior import Prior
from oasis_warp.avatar.quality import (
    SEEN,
    SurfaceQuality,
    assess_surface,
    combine_quality,
    coverage_warnings,
    photo_warnings,
    shares,
)
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent, timed_stage
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandFit, Landmarks, Photo, PosedHand
from oasis_warp.estimation.estimator import HandEstimator, choose_hand, shared_shape
from oasis_warp.hand.skinning import rest_hand
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.network.prior import choose_prior
from oasis_warp.ops import warm_up
from oasis_warp.reconstruction import (
    COARSE_SIZE,
    composite_over_photo,
    crop_hand,
    crop_side,
    finer_size,
    initial_offsets,
    input_errors,
    is_low_resolution,
    make_avatar,
    refine_offsets,
)

OTHER_LIGHT = 1.6
"""Times by which a photo is brighter or darker than the first, in any channel, from which it is worth a warning."""
NOTHING_NEW = 0.5
"""Share of the surface [%] that a photo must show better than all others, or it was not needed."""


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


class FusedReconstruction(NamedTuple):
    """An avatar of several photos and how it came about."""

    avatar: Avatar
    """In the light of the first photo, whose pose and camera are its source."""
    photos: tuple[PhotoOfHand, ...]
    prior: Mapping[str, str | int]
    """Which prior was asked: its `about`."""
    stages: dict[str, float]
    """Seconds of each stage."""
    errors: dict[str, float]
    """What any of the photos shows of the surface: as `avatar.quality.shares`; n_gaussians."""
    warnings: tuple[str, ...]
    quality: SurfaceQuality
    """How well each place of the surface is known."""


def reconstruct_same_hand(
    photos: Sequence[Photo],
    config: ReconstructConfig = ReconstructConfig(),  # noqa: B008 - frozen
    *,
    prior: Prior | None = None,
    progress: Progress = silent,
) -> FusedReconstruction:
    """Make one avatar of one hand of which there are several photos, of any poses and sides.

    Args:
        photos: From `oasis_warp.read_photo`. The first decides on exposure and white balance, the source pose and the
            source camera. Of one photo alone comes what `reconstruct` makes of it; shading of several is
            evened out.
        config: Options, for every photo.
        prior: What to assume of a hand before its photos are fitted; the one that `config.prior` names when not given.
        progress: Called as work goes on.

    Raises:
        ValueError: no photo.
        InputError: a photo without such a hand, with a hand of the other side, or with a fit too poor to go on (see
            `ReconstructConfig.force`); the sentence names it. Or a wrong file.
    """
    if not photos:
        raise ValueError("photos: expected at least one, got none. Read them with oasis_warp.read_photo.")
    stages: dict[str, float] = {}

    def stage(name: str) -> AbstractContextManager[None]:
        return timed_stage(name, stages, progress)

    estimator = HandEstimator(bundled_hand())
    with stage("prior"):
        prior = prior or choose_prior(config.prior, config.backbone_weights)
    landmarks = []
    for photo in photos:
        with stage("landmarks"):
            landmarks.append(choose_hand(estimator.find(photo), config.hand, photo.name))
    check_sides(photos, landmarks)
    with stage("fit"):
        fits = fit_together(estimator, photos, landmarks, force=config.force, progress=progress)
    with stage("outline"):
        surfaces = fit_surfaces(fits)
    with stage("kernels"):
        warm_up(config.device)
    with stage("crop"):
        crops = crop_hands(photos, fits, surfaces, config)
    guesses = []
    for crop in crops:
        with stage("guesses"):
            guesses.append(prior(crop))
    with stage("outline"):
        surfaces = settle_surfaces(photos, fits, surfaces, guesses, config)
        crops = crop_hands(photos, fits, surfaces, config)
    with stage("fusion"):
        if is_low_resolution(config, *fits):
            guesses = [coarsen(estimator.hand, guess, crops[0].rest) for guess in guesses]
        settings = AdaptConfig(light=config.light, texture_steps=config.steps, seed=config.seed)
        fusion = fuse(estimator.hand, crops, resolutions(fits, crops), guesses, settings, progress)
    with stage("detail"):
        gaussians, close = with_detail(fusion, photos, fits, surfaces, config, progress)
    lights = fusion.lights or [None] * len(photos)
    avatar = make_avatar(fits[0], surfaces.shared, crops[0], gaussians, lights[0])
    with stage("quality"):
        about, qualities = [], []
        parts = zip(photos, fits, surfaces.own, crops, close, fusion.gains, lights, strict=True)
        for (photo, fit, own, crop, near, gain, light), seen in zip(
            parts, surface_shares(crops[0], fusion.sightings), strict=True
        ):
            # in the photo's own light, and on the surface by which it was read
            in_its_light = gaussians._replace(colors=(gaussians.colors * gain).clamp(0, 1))
            there = make_avatar(fit, own, crop, in_its_light, light)
            qualities.append(assess_surface(estimator.hand, crop, composite_over_photo(there, crop)))
            errors = {
                "reprojection_percent": fit.reprojection,
                "worst_point_percent": fit.worst_point,
                "mask_iou": fit.mask_iou,
                **{name: value for name, value in input_errors(there, near).items() if name != "n_gaussians"},
                **seen,
            }
            red, green, blue = gain.tolist()
            about.append(PhotoOfHand(photo.name, fit, (red, green, blue), errors))
        quality = combine_quality(qualities)
        shown = shares(estimator.hand, crops[0].rest.vertices, quality)
        doubts = [photo_warnings(near.image, near.mask, crop_side(fit)) for near, fit in zip(close, fits, strict=True)]
    errors = {"n_gaussians": float(len(gaussians.opacities)), **shown}
    said = (*_warnings(about, doubts), *coverage_warnings(shown))
    return FusedReconstruction(avatar, tuple(about), prior.about, stages, errors, said, quality)


def check_sides(photos: Sequence[Photo], landmarks: Sequence[Landmarks]) -> None:
    """All hands must be of one side: mirrored, the other hand would be another one.

    Raises:
        InputError: some are not; it names those that the fewer, or less sure, say so.
    """
    for_right = sum((1 if found.side == "right" else -1) * found.side_score for found in landmarks)
    side = landmarks[0].side if for_right == 0 else "right" if for_right > 0 else "left"
    odd = [photo.name for photo, found in zip(photos, landmarks, strict=True) if found.side != side]
    if odd:
        shows = "shows" if len(odd) == 1 else "show"
        other = "left" if side == "right" else "right"
        raise InputError(
            f"{' and '.join(odd)}: {shows} a {other} hand, the other photos a {side} one; give photos of one hand, or "
            f"--hand {side} where both hands are in a photo."
        )


def fit_together(
    estimator: HandEstimator, photos: Sequence[Photo], landmarks: Sequence[Landmarks], *, force: bool = False,
    progress: Progress = silent,
) -> list[HandFit]:  # fmt: skip
    """Fits of all photos with one shape: each alone first, then again with the shape that they agree on.

    Raises:
        InputError: as `HandEstimator.fit`, of a photo alone; that a shared shape suits it less is only warned about.
    """
    pairs, fits = list(zip(photos, landmarks, strict=True)), []
    total = len(pairs) if len(pairs) == 1 else 2 * len(pairs)
    for photo, points in pairs:
        fits.append(estimator.fit(photo, points, force=force))
        progress("fit", len(fits), total)
    if len(fits) == 1:
        return fits
    shape, again = shared_shape([fit.shape for fit in fits]), []
    for photo, points in pairs:
        again.append(estimator.fit(photo, points, shape=shape, force=True)._replace(shape=shape))
        progress("fit", len(pairs) + len(again), total)
    return again


class Surfaces(NamedTuple):
    """From the fitted rest surface to those that carry Gaussians [m]."""

    shared: Float[Tensor, "V 3"]
    """The avatar's, nearest to all outlines at once."""
    own: list[Float[Tensor, "V 3"]]
    """That of each photo, by which it is read: on its own outline no background gets on the hand."""


def fit_surfaces(fits: Sequence[HandFit]) -> Surfaces:
    """See `reconstruction.initial_offsets`, of all fits together and of each."""
    hand = bundled_hand()
    own = [initial_offsets(hand, fit) for fit in fits]
    return Surfaces(own[0] if len(own) == 1 else initial_offsets(hand, *fits), own)


def settle_surfaces(
    photos: Sequence[Photo], fits: Sequence[HandFit], surfaces: Surfaces, guesses: Sequence[CanonicalGaussians],
    config: ReconstructConfig,
) -> Surfaces:  # fmt: skip
    """See `reconstruction.refine_offsets`, of all photos together and of each."""
    hand, each = bundled_hand(), zip(photos, fits, surfaces.own, guesses, strict=True)
    own = [
        refine_offsets(hand, [photo], [fit], offsets, [guess], config) for photo, fit, offsets, guess in each
    ]
    if len(own) == 1:
        return Surfaces(own[0], own)
    return Surfaces(refine_offsets(hand, photos, fits, surfaces.shared, guesses, config), own)


def crop_hands(
    photos: Sequence[Photo],
    fits: Sequence[HandFit],
    surfaces: Surfaces,
    config: ReconstructConfig,
    *,
    finer: bool = False,
) -> list[HandCrop]:
    """As `reconstruction.crop_hand`, each photo seen on its own surface, all with the shared one at rest.

    All of one size, or with `finer` each as large as its detail, if that is larger.
    """
    plain = rest_hand(bundled_hand(), fits[0].shape)
    shared = plain._replace(vertices=plain.vertices + surfaces.shared)
    crops = []
    for photo, fit, own in zip(photos, fits, surfaces.own, strict=True):
        crop = crop_hand(photo, fit, own, config, finer_size(fit, config) if finer else None)
        crops.append(crop._replace(rest=PosedHand(*(part.to(crop.image) for part in shared))))
    return crops


def resolutions(fits: Sequence[HandFit], crops: Sequence[HandCrop]) -> list[float]:
    """Pixels of each photo a pixel of its crop, along a line."""
    return [float(fit.camera.K[0, 0] / e.camera.K[0, 0]) for fit, e in zip(fits, crops, strict=True)]


def with_detail(
    fusion: Fusion,
    photos: Sequence[Photo],
    fits: Sequence[HandFit],
    surfaces: Surfaces,
    config: ReconstructConfig,
    progress: Progress = silent,
) -> tuple[CanonicalGaussians, list[HandCrop]]:
    """The Gaussians of `fusion` with the detail that `config` asks for, and the crops that show it."""
    close = crop_hands(photos, fits, surfaces, config, finer=True)
    if all(finer_size(fit, config) is None for fit in fits):
        return fusion.gaussians, close
    resolution = resolutions(fits, close)
    return add_detail(bundled_hand(), fusion, close, resolution, COARSE_SIZE, progress), close


def surface_shares(crop: HandCrop, sightings: VertexObservations) -> list[dict[str, float]]:
    """Of the hand's surface at rest [%]: what each photo shows, and what it shows best of all."""
    seen = sightings.confidence >= SEEN
    best = (sightings.confidence * sightings.share).argmax(0)
    return [
        {
            "seen_percent": 100 * _area_share(crop, shown),
            "best_percent": 100 * _area_share(crop, shown & (best == k)),
        }
        for k, shown in enumerate(seen)
    ]


def _area_share(crop: HandCrop, where: Tensor) -> float:
    faces = bundled_hand().faces.to(crop.image.device)
    areas = surface.vertex_areas(crop.rest.vertices, faces)
    return float((areas * where).sum() / areas.sum())


def _warnings(photos: Sequence[PhotoOfHand], doubts: Sequence[Sequence[str]]) -> list[str]:
    """Of the fits, the photos (`doubts`) and how they go together; each begins with the photo's name."""
    said = [
        f"{photo.name}: {warning}"
        for photo, own in zip(photos, doubts, strict=True)
        for warning in (*photo.fit.warnings, *own)
    ]
    for photo in photos[1:]:
        factor = max(photo.gain, key=lambda gain: max(gain, 1 / gain))
        if max(factor, 1 / factor) > OTHER_LIGHT:
            how = f"{factor:.1f} times as bright as" if factor > 1 else f"{1 / factor:.1f} times darker than"
            said.append(f"{photo.name}: its light is another, {how} {photos[0].name}; its colours may not fit in")
        if photo.errors["best_percent"] < NOTHING_NEW:
            said.append(f"{photo.name}: adds next to nothing, other photos show all of it as well or better")
    return said
