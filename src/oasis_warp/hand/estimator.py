"""`HandEstimator`: a photo -> the hands in it -> one of them explained by the model."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, HandFit, HandPose, Landmarks, Photo
from oasis_warp.hand.fit import Evidence, Fitter, evidence_of
from oasis_warp.hand.fit_quality import DOUBTFUL, REFUSED, TINY_HAND, Quality, measure
from oasis_warp.hand.fit_state import FitState
from oasis_warp.hand.kinematics import Rig
from oasis_warp.hand.landmarks import box_size, find_hands
from oasis_warp.hand.networks import networks
from oasis_warp.hand.outline import MaskOutline
from oasis_warp.hand.segmentation import cut_at_wrist, mask_from_landmarks

_ROUNDS = 4
"""Rounds of pairing outlines with a mask."""


class HandEstimator:
    """Finds hands with the two bundled networks and fits `hand` to them. Same photo, same bits."""

    def __init__(self, hand: HandModel):
        self.hand = hand
        self.rig = Rig(hand)

    def find(self, photo: Photo) -> list[Landmarks]:
        """The hands of a photo, best first; empty when there is none.

        When nothing is found plainly, the photo is searched again with a margin, brightened, and with a lower bound;
        `Landmarks.source` says which way found it.

        Raises:
            InputError: this installation cannot run the networks (see `networks.check_networks`).
        """
        found = find_hands(photo.rgb.numpy(), networks())
        return [
            Landmarks(
                xy=_real(hand.xy),
                world=_real(hand.world),
                side="right" if hand.right > 0.5 else "left",
                side_score=hand.side_score,
                presence=hand.presence,
                source=hand.source,
            )
            for hand in found
        ]

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
            shape: Keep these coefficients, of a person who was fitted before.
            force: Return a fit that would be refused, its faults among the warnings.

        Raises:
            InputError: the hand is too small, or the model does not explain it.
        """
        size = box_size(_array(landmarks.xy))
        if size < TINY_HAND and not force:
            raise InputError(
                f"{photo.name}: the hand is {size:.0f} pixels large, at least {TINY_HAND} are needed; "
                "give a closer or larger photo."
            )
        view = _RightView(photo, landmarks, focal)
        fitter = Fitter(self.rig, view.evidence, shape=None if shape is None else _array(shape))
        start = fitter.fit_landmarks()
        mask = view.first_mask(self._pixels_per_metre(start.state))
        outline = MaskOutline(mask, view.evidence.xy)
        found = fitter.refine(start.state, lambda state: outline.match(self.rig, state), _ROUNDS)
        quality = measure(self.rig, view.evidence, found.state, mask, found.cost)
        return self._report(view, landmarks, found.state, mask, quality, force)

    def _pixels_per_metre(self, state: FitState) -> float:
        return state.focal / float(np.exp(state.place[2]))

    def _report(self, view: "_RightView", landmarks: Landmarks, state: FitState, mask: np.ndarray, quality: Quality,
                force: bool) -> HandFit:  # fmt: skip
        refused = quality.beyond(REFUSED)
        if refused and not force:
            raise InputError(
                f"{view.name}: the fit of the {landmarks.side} hand is too poor to use, {' and '.join(refused)}; "
                "give a sharper photo of the open hand, or force it."
            )
        warnings = [f"poor fit: {words}" for words in quality.beyond(DOUBTFUL)]
        return HandFit(
            side=landmarks.side,
            shape=_real(state.shape),
            pose=view.pose(self.rig, state),
            camera=view.camera(state),
            landmarks=landmarks,
            mask=torch.from_numpy(view.photo_way(mask)),
            reprojection=quality.reprojection,
            worst_point=quality.worst_point,
            mask_iou=quality.mask_iou,
            cost=quality.cost,
            warnings=tuple(warnings),
        )


class _RightView:
    """One hand of a photo, mirrored into a right one; results are mirrored back."""

    def __init__(self, photo: Photo, landmarks: Landmarks, focal: float | None):
        self.name, self.mirrored = photo.name, landmarks.side == "left"
        rgb, xy = photo.rgb.numpy(), _array(landmarks.xy)
        world = None if landmarks.world is None else _array(landmarks.world)
        height, width = rgb.shape[:2]
        if self.mirrored:
            xy = np.array([width, 0]) + xy * [-1, 1]
            world = None if world is None else world * [-1, 1, 1]
        self.rgb = self.photo_way(rgb)
        self.alpha = None if photo.alpha is None else self.photo_way(photo.alpha.numpy())
        self.evidence: Evidence = evidence_of(xy, world, (width, height), focal or photo.focal)

    def photo_way(self, image: np.ndarray) -> np.ndarray:
        """An image [H, W, ...] of the photo mirrored into this view, or back."""
        return np.ascontiguousarray(image[:, ::-1]) if self.mirrored else image

    def first_mask(self, scale: float) -> np.ndarray:
        """Mask before anything but the landmarks is known."""
        if self.alpha is not None:
            return cut_at_wrist(self.alpha, self.evidence.xy, scale)
        return mask_from_landmarks(self.rgb, self.evidence.xy, scale)

    def pose(self, rig: Rig, state: FitState) -> HandPose:
        """The pose in the photo's own frame."""
        mirror = np.array([-1.0, 1, 1]) if self.mirrored else np.ones(3)
        return HandPose(
            angles=_real(rig.all_angles(state.angles)[1:]),
            orientation=_real(mirror[:, None] * state.turn * mirror),
            translation=_real(mirror * state.translation()),
        )

    def camera(self, state: FitState) -> Camera:
        """The camera of the photo."""
        width, height = self.evidence.size
        K = np.array([[state.focal, 0, width / 2], [0, state.focal, height / 2], [0, 0, 1]])
        return Camera(torch.eye(4), _real(K), width, height)


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
        return max(found, key=lambda hand: box_size(_array(hand.xy)))
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
        f"{i}: {hand.side}, {box_size(_array(hand.xy)):.0f} px" for i, hand in enumerate(found)
    )
    raise InputError(f"{photo_name}: expected {wanted}, found {listed}; choose one of these, or mirror the photo.")


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float64)


def _real(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
