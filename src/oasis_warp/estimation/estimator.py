"""`HandEstimator`: a photo -> the hands in it -> one of them explained by the model."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.processes import single_threaded_math
from oasis_warp.core.types import HandFit, Landmarks, Photo
from oasis_warp.estimation.fit import Fitter, Solution, SurfacePoints
from oasis_warp.estimation.fit_problem import MirroredInput, array, real
from oasis_warp.estimation.fit_quality import (
    MANY_FINGERS,
    TINY_HAND,
    finger_warnings,
    fit_quality,
    framing_warnings,
    second_detections,
    side_costs,
    side_warnings,
    stray_pixels,
)
from oasis_warp.estimation.landmarks import box_size, detect_hands
from oasis_warp.estimation.networks import networks
from oasis_warp.estimation.outline import MaskOutline
from oasis_warp.estimation.pixel_reading import (
    PixelReading,
    bundled_dense_network,
    read_pixels,
    surface_points,
    surface_reading,
)
from oasis_warp.estimation.segmentation import check_opencv, mask_from_alpha, mask_from_reading
from oasis_warp.estimation.shape_prior import shape_prior
from oasis_warp.hand.kinematics import HandKinematics

_NO_HAND = 16
"""Smaller hands are refused even by force [px]."""
_ROUNDS = 2
"""Rounds of pairing outlines."""
_CLEARLY = 0.5
"""Least sine of the angle at the wrist between index and little finger for palm or back to be plain. Of 60 photos
of flat hands, gestures and fists the plain ones have .53 to .80; hands seen edge-on have .07 to .43."""


class _FittedPixels(NamedTuple):
    found: Solution
    mask: np.ndarray
    points: SurfacePoints
    reading: PixelReading
    warnings: list[str]


def _check_landmarks(landmarks: Landmarks, name: str, least: int) -> None:
    if not bool(landmarks.xy.isfinite().all()):
        raise ValueError("landmarks: expected finite pixels, got others. Leave out a hand that is not found.")
    size = box_size(array(landmarks.xy))
    if size < least:
        raise InputError(
            f"{name}: the hand is {size:.0f} pixels large, at least {least} are needed; give a closer or larger photo."
        )


class HandEstimator:
    """Finds hands with the two bundled networks and fits `hand` to them. Same photo, same bits."""

    def __init__(self, hand: HandModel, device: str = "cpu"):
        """Raises InputError where OpenCV is another than the estimator needs.

        Args:
            hand: On the CPU.
            device: Where the dense network reads pixels; all else is done on the CPU.
        """
        check_opencv()
        self.hand, self.device = hand, device
        self.kinematics = HandKinematics(hand)

    def find(self, photo: Photo) -> list[Landmarks]:
        """The hands of a photo, best first; empty when there is none.

        A photo without a hand is searched again with a margin, brightened, and with a lower bound of the score;
        `Landmarks.source` says which search found the hand.

        Raises:
            InputError: this installation cannot run the networks (see `networks.check_networks`).
        """
        found = detect_hands(photo.rgb.numpy(), networks())
        return [
            Landmarks(
                xy=real(hand.xy),
                world=real(hand.world),
                side="right" if hand.right > 0.5 else "left",
                side_score=hand.side_score,
                presence=hand.presence,
                source=hand.source,
            )
            for hand in found
        ]

    @single_threaded_math()
    def fit(
        self,
        photo: Photo,
        landmarks: Landmarks,
        *,
        focal: float | None = None,
        shape: Float[Tensor, "S"] | None = None,
        force: bool = False,
    ) -> HandFit:
        """Shape, pose, camera and mask of one hand.

        Args:
            photo: The photo.
            landmarks: The hand in it.
            focal: Focal length [px] where it is known better than the photo's own; without either it is fitted.
            shape: Coefficients to keep, of a person who was fitted before.
            force: Return a fit that would be refused, with its faults among the warnings.

        Raises:
            ValueError: landmarks that are not finite.
            InputError: the hand is too small, or the model does not explain it.
        """
        _check_landmarks(landmarks, photo.name, _NO_HAND if force else TINY_HAND)
        view = MirroredInput(photo, landmarks, focal)
        known_shape = None if shape is None else array(shape)
        fitter = Fitter(self.kinematics, view.target, shape=known_shape)
        start = fitter.fit_landmarks()
        found, mask, points, reading, warnings = self._fit_pixels(view, fitter, start)
        quality = fit_quality(self.kinematics, view.target, found.state, mask, found.cost)
        detections = second_detections(view.rgb, networks(), view.target.xy)
        fingers = finger_warnings(view.target, detections)
        stray, stray_fingers = stray_pixels(self.kinematics, view.target, found.state, points)
        framing = framing_warnings(view.target, mask)
        warnings = [*quality.warnings(), *warnings, *framing, *fingers, *stray_fingers]
        if landmarks.world is not None:  # 21 points in the plane alone do not tell a palm from the other hand's back
            costs = side_costs(self.kinematics, view.target, known_shape)
            warnings += side_warnings(landmarks.side, *costs, detections)
        refused = quality.refused(stray)
        if len(fingers) >= MANY_FINGERS:
            refused.append("a second detection places the hand elsewhere")
        if refused and not force:
            raise InputError(
                f"{photo.name}: the fit of the {landmarks.side} hand is too poor to use, {' and '.join(refused)}; "
                "give a sharper photo of the open hand, or use the fit anyway with --force."
            )
        return HandFit(
            side=landmarks.side,
            shape=real(found.state.shape),
            pose=view.pose(self.kinematics, found.state),
            camera=view.camera(found.state),
            landmarks=landmarks,
            mask=real(view.in_photo(mask)),
            **vars(quality),
            warnings=tuple(warnings),
            reading=surface_reading(reading, view),
        )

    def _fit_pixels(self, view: MirroredInput, fitter: Fitter, start: Solution) -> _FittedPixels:
        """Fit to the surface that the dense network reads and to the mask's outline."""
        warnings = []
        xy, scale = view.target.xy, start.state.pixels_per_metre()
        reading = read_pixels(view.rgb, xy, bundled_dense_network(self.device))
        mask = None if view.alpha is None else mask_from_alpha(view.alpha, reading, xy, scale)
        if view.alpha is not None and mask is None:
            warnings.append("the photo's transparency was ignored: it does not outline this whole hand alone")
        mask = mask_from_reading(view.rgb, reading, xy) if mask is None else mask
        outline, points = MaskOutline(mask, xy), surface_points(self.kinematics, reading, scale)
        found = fitter.fit_surface(start.state, points)
        found = fitter.refine(found.state, lambda state: outline.match(self.kinematics, state), _ROUNDS, points)
        return _FittedPixels(found, mask, points, reading, warnings)


def choose_hand(
    found: Sequence[Landmarks], which: Literal["left", "right", "largest"] | int, photo_name: str
) -> Landmarks:
    """One of the hands that were found: the first of a side, the largest, or by number, counted from 0.

    Raises:
        InputError: there is none, or not that one; the sentence lists what was found.
    """
    if not found:
        raise InputError(
            f"{photo_name}: found no hand; give a photo of one whole hand in good light, with some border around it."
        )
    if which == "largest":
        return max(found, key=lambda hand: box_size(array(hand.xy)))
    if isinstance(which, int):
        if 0 <= which < len(found):
            return found[which]
        wanted = f"hand {which}"
    else:
        of_side = [hand for hand in found if hand.side == which]
        if of_side:
            return of_side[0]
        wanted = f"a {which} hand"
    listed = ", ".join(
        f"hand {i} ({hand.side}, {box_size(array(hand.xy)):.0f} px)" for i, hand in enumerate(found)
    )
    raise InputError(f"{photo_name}: expected {wanted}, found {listed}; choose another --hand, or mirror the photo.")


def shared_shape(shapes: Sequence[Float[Tensor, "S"]], expected: Float[Tensor, "S"]) -> Float[Tensor, "S"]:
    """The mean of the shapes fitted to photos of one hand, shrunk towards the `expected` one as far as they disagree.

    One photo does not determine a shape, and errors of its landmarks decide the rest. The spread of the shapes s_k of K
    photos estimates these errors: with W the sum of their sample variances and e the expected shape, the mean m becomes

        e + (m - e) max(0, 1 - W / (K |m - e|^2)),

    the positive-part shrinkage of James and Stein (1961) with estimated variance. Shapes that agree are kept. On
    synthetic hands and on held-out photos of real ones this explains more than any photo's own shape, their mean, or
    the sum of the fits' information, whose errors are not independent.

    Args:
        shapes: Coefficients [standard deviations], of one photo or more.
        expected: Those of the prior.
    """
    table = torch.stack(list(shapes))
    mean = table.mean(0)
    if len(table) == 1:
        return mean
    noise = table.var(0).sum() / len(table)
    apart = mean - expected
    return expected + apart * (1 - noise / apart.square().sum().clamp_min(1e-12)).clamp_min(0)


def check_sides(photos: Sequence[Photo], landmarks: Sequence[Landmarks | HandFit]) -> None:
    """Check that all hands are of one side; a hand of the other side, mirrored, would be another hand.

    Raises:
        InputError: some are not; it names the photos of the side that is shown less often or less clearly.
    """
    for_right = sum(
        (1 if found.side == "right" else -1) * (found.side_score if isinstance(found, Landmarks) else 1.0)
        for found in landmarks
    )
    side = landmarks[0].side if for_right == 0 else "right" if for_right > 0 else "left"
    odd = [photo.name for photo, found in zip(photos, landmarks, strict=True) if found.side != side]
    if odd:
        shows = "shows" if len(odd) == 1 else "show"
        other = "left" if side == "right" else "right"
        raise InputError(
            f"{' and '.join(odd)}: {shows} a {other} hand, the other photos a {side} one; give photos of one hand, or "
            f"--hand {side} where both hands are in a photo."
        )


def palm_and_back(one: Landmarks, other: Landmarks) -> bool:
    """Whether two photos plainly show a palm and a back of the same side, as two photos of one hand do."""
    facing = sorted((_facing(one), _facing(other)))
    return one.side == other.side and facing[0] < -_CLEARLY and facing[1] > _CLEARLY


def _facing(found: Landmarks) -> float:
    """Sine of the angle at the wrist from the index finger to the little one: below 0 where the palm is seen."""
    index, little = found.xy[5] - found.xy[0], found.xy[17] - found.xy[0]
    cross = index[0] * little[1] - index[1] * little[0]
    sine = float(cross / (index.norm() * little.norm()).clamp_min(1e-6))
    return sine if found.side == "right" else -sine


def fit_together(
    estimator: HandEstimator, photos: Sequence[Photo], landmarks: Sequence[Landmarks | HandFit], *,
    force: bool = False, progress: Progress = silent,
) -> list[HandFit]:  # fmt: skip
    """Fits of all photos with one shape: each alone first, then again with the shape that they agree on.

    A single photo's fit stays as it is, whether computed here or given in place of landmarks.

    Raises:
        InputError: as `HandEstimator.fit`, of a photo alone; that a shared shape suits it less is only warned about.
    """
    if len(landmarks) == 1 and isinstance(landmarks[0], HandFit):
        return [landmarks[0]]
    pairs, fits = list(zip(photos, landmarks, strict=True)), []
    total = len(pairs) if len(pairs) == 1 else 2 * len(pairs)
    for photo, points in pairs:
        fits.append(estimator.fit(photo, points, force=force))
        progress("fit", len(fits), total)
    if len(fits) == 1:
        return fits
    expected = real(shape_prior(estimator.kinematics.hand)[0])
    shape, again = shared_shape([fit.shape for fit in fits], expected), []
    for photo, points in pairs:
        again.append(estimator.fit(photo, points, shape=shape, force=True)._replace(shape=shape))
        progress("fit", len(pairs) + len(again), total)
    return again
