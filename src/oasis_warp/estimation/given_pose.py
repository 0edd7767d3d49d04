"""A `HandFit` from a shape, pose and camera that come from elsewhere: only the mask is looked for in the photo."""

from dataclasses import replace

import numpy as np
import torch

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import mirror_landmarks
from oasis_warp.core.types import Camera, HandFit, HandPose, Landmarks, Photo, Side
from oasis_warp.estimation.fit_quality import WARN_BOUNDS, draw, measure
from oasis_warp.estimation.fit_warnings import framing_warnings
from oasis_warp.estimation.mirrored_input import MirroredInput, mirrored_state, real
from oasis_warp.estimation.segmentation import mask_from_alpha, mask_from_fit, mask_from_landmarks
from oasis_warp.hand.kinematics import HandKinematics


def fit_of_pose(
    hand: HandModel, photo: Photo, side: Side, shape: np.ndarray, pose: HandPose, camera: Camera, source: str
) -> HandFit:
    """The photo's hand as a given pose explains it; the landmarks are the model's own, so their error is zero.

    Args:
        hand: The model that `shape` and `pose` belong to.
        photo: The photo.
        side: Whose pose it is; a left hand's describes the mirrored model.
        shape: Coefficients, [S].
        pose: In the camera's frame.
        camera: Of the photo, its viewmat the identity.
        source: What to call the origin in `Landmarks.source`.
    """
    rig = HandKinematics(hand)
    state = mirrored_state(rig, side, shape, pose, camera)
    points = rig.landmarks(rig.chain(state.angles, state.shape), state.shape)[0]
    xy, world = torch.from_numpy(state.project(points)), torch.from_numpy(state.in_camera(points))
    landmarks = Landmarks(xy, world - world.mean(0), "right", 1.0, 1.0, source)
    if side == "left":
        landmarks = mirror_landmarks(landmarks, camera.width)
    landmarks = landmarks._replace(xy=landmarks.xy.float(), world=landmarks.world.float())
    view = MirroredInput(photo, landmarks, state.focal)
    state = replace(state, focal=state.focal * float(view.scale[0]), centre=state.centre * view.scale)
    scale, seen = state.focal / float(np.exp(state.place[2])), view.evidence.xy
    mask = None if view.alpha is None else mask_from_alpha(view.alpha, seen, scale)
    if mask is None:
        first = mask_from_landmarks(view.rgb, seen, scale)
        mask = mask_from_fit(view.rgb, seen, scale, first, draw(rig, state, view.evidence.size))
    quality = measure(rig, view.evidence, state, mask, 0.0)
    warnings = [f"poor fit: {words}" for words in quality.beyond(WARN_BOUNDS)] + framing_warnings(view.evidence, mask)
    return HandFit(
        side=side,
        shape=real(shape),
        pose=pose,
        camera=camera,
        landmarks=landmarks,
        mask=real(view.in_photo(mask)),
        reprojection=quality.reprojection,
        worst_point=quality.worst_point,
        mask_iou=quality.mask_iou,
        cost=quality.cost,
        warnings=tuple(warnings),
    )
