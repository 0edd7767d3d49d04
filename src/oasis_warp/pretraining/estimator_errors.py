"""Errors of the estimator as measured: hands are perturbed like similar hands were when they were estimated.

`studies/estimator_errors.py` renders synthetic hands, estimates them as `reconstruction.reconstruct` does, and
keeps the differences. One photo determines the hand in the picture but hardly its depth, so errors of joints,
orientation, shape and focal length are large and correlated: sampled independently they would move the surface far off
its picture. An error is therefore taken as a whole from one measured hand, one of those that look most similar from the
camera. Then its effect on the landmarks in the picture is corrected: they are off as that hand's were, and the surface
follows. Last, as in `estimation.surface_offsets`, the outline moves back to its true place.

Masks get the errors that the estimator's GrabCut makes (docs/estimator.md): another end at the wrist, filled gaps
between fingers, and a wandering outline. They are computed in batches of fixed sizes on the device of the pictures.
"""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from safetensors.torch import load
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, normalize, pad

from oasis_warp.assets import asset
from oasis_warp.core.hand_model import KNUCKLES, HandModel
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.hand.template import bundled_hand
from oasis_warp.pretraining.hand_batch import FINGERS, PosedHands, pose_hands

ALIKE = 8
"""Number of most similar measured hands; one of them provides the error."""
_WRIST, _MIDDLE = 0, 9
"""Landmarks that define the direction of a hand."""
_BONES = (*((0, k) for k in range(1, 21, 4)), *((k, k + 1) for k in range(1, 20) if k % 4))
"""First and last landmark of each bone."""
_FORESHORTENED = 0.1
"""Projected length of a bone, over that of the palm, below which it is taken to point like the palm."""
_GRAZING = 0.5
"""Largest |normal . view| at the outline; vertices belong to it less and less up to there."""
_SOFT = 0.004
"""Distance below which bones influence a vertex equally [m]."""


class MeasuredErrors(NamedTuple):
    """Errors of M hands, each rotated about the camera's axis until it points upwards; metres and radians."""

    looks: Float[Tensor, "M 63"]
    """True landmarks minus their mean, in the camera's frame."""
    angles: Float[Tensor, "M 15 3"]
    """Estimated minus true angles."""
    turn: Float[Tensor, "M 3"]
    """Rotation vector from the true to the estimated orientation, about the camera's axes."""
    shape: Float[Tensor, "M S"]
    """Estimated coefficients minus `kept` times the true ones."""
    lens: Float[Tensor, "M 2"]
    """Logarithms of estimated over true focal length, and of estimated over true size of a pixel at the hand."""
    place: Float[Tensor, "M 21 2"]
    """Error of landmarks in the picture, in metres at the hand's true distance."""
    kept: Float[Tensor, "S"]
    """Share of each shape coefficient that the estimator recovers."""
    shares: Float[Tensor, "V 21"]
    """Weights with which a vertex follows the landmarks; rows sum to one."""
    normals: Float[Tensor, "V 3"]
    """Vertex normals of the surface at rest."""

    def scaled(self, strength: float) -> "MeasuredErrors":
        """The errors times `strength`; 0 for none."""
        if strength == 1:
            return self
        smaller = {name: strength * getattr(self, name) for name in ("angles", "turn", "shape", "lens", "place")}
        return self._replace(**smaller, kept=1 - strength * (1 - self.kept))


class EstimatedHands(NamedTuple):
    """Estimates of N hands: surfaces in the camera's frame [m], and intrinsics [px]."""

    posed: Float[Tensor, "N V 3"]
    K: Float[Tensor, "N 3 3"]


@functools.cache
def bundled_errors(device: torch.device) -> MeasuredErrors:
    """The errors that ship with the package, for the bundled hand."""
    stored = load(asset("training", "estimator_errors.safetensors").read_bytes())
    tensors = {name: value.float() for name, value in stored.items()} | surface_fields(bundled_hand())
    return MeasuredErrors(**{name: value.to(device) for name, value in tensors.items()})


def surface_fields(hand: HandModel) -> dict[str, Tensor]:
    """The fields of `MeasuredErrors` that depend on the hand model only."""
    a, b, c = hand.template[hand.faces].unbind(1)
    across = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(hand.template).index_add_(0, hand.faces.flatten(), across.repeat_interleave(3, 0))
    return {"shares": landmark_shares(hand), "normals": normalize(normals, dim=-1)}


def landmark_shares(hand: HandModel) -> Float[Tensor, "V 21"]:
    """Weights with which vertices follow landmarks: those of the nearest bones, linear along each bone."""
    points = torch.cat([hand.joints, hand.tips])[hand.keypoint_index]
    ends = torch.tensor(_BONES, device=points.device)
    start, end = points[ends].unbind(1)
    arm = end - start
    along = (((hand.template[:, None] - start) * arm).sum(-1) / (arm * arm).sum(-1)).clamp(0, 1)
    away = (hand.template[:, None] - start - along[..., None] * arm).norm(dim=-1)
    near = 1 / (away**2 + _SOFT**2) ** 2
    near = near / near.sum(1, keepdim=True)
    shares = torch.zeros(len(hand.template), len(points), device=points.device)
    shares.index_add_(1, ends[:, 0], near * (1 - along))
    return shares.index_add_(1, ends[:, 1], near * along)


class Frames(NamedTuple):
    """Directions in the picture, as rotations about the camera's axis from the upward direction."""

    hand: Float[Tensor, "N 3 3"]
    """From wrist to middle knuckle."""
    landmarks: Float[Tensor, "N 21 2 2"]
    """Along the bone that ends at a landmark; for wrist and knuckles along the palm."""


def picture_frames(landmarks: Float[Tensor, "N 21 3"]) -> Frames:
    """Directions of hands and their fingers in the picture, from landmarks in the camera's frame."""
    seen = landmarks[..., :2] / landmarks[..., 2:]
    up = seen[:, _MIDDLE] - seen[:, _WRIST]
    fingers = seen[:, 1:].unflatten(1, (FINGERS, 4))
    bones = fingers.diff(dim=2) + _FORESHORTENED * up[:, None, None]
    knuckles = up[:, None, None].expand(-1, FINGERS, 1, -1)
    along = torch.cat([up[:, None], torch.cat([knuckles, bones], 2).flatten(1, 2)], 1)
    x, y = normalize(along, dim=-1).unbind(-1)
    rotations = torch.stack([-y, -x, x, -y], -1).unflatten(-1, (2, 2))
    hand = pad(rotations[:, 0], (0, 1, 0, 1))
    hand[:, 2, 2] = 1
    return Frames(hand, rotations)


def looks(landmarks: Float[Tensor, "N 21 3"], frames: Frames) -> Float[Tensor, "N 63"]:
    """Landmarks as in `MeasuredErrors.looks`."""
    return ((landmarks - landmarks.mean(1, keepdim=True)) @ frames.hand).flatten(1)


def simulate_estimate(
    hand: HandModel,
    true: PosedHands,
    shape: Float[Tensor, "N S"],
    angles: Float[Tensor, "N 15 3"],
    orientation: Float[Tensor, "N 3 3"],
    K: Float[Tensor, "N 3 3"],
    measured: MeasuredErrors,
    choice: Int[Tensor, "N"],
) -> EstimatedHands:
    """Surfaces and cameras with the estimator's errors.

    Args:
        hand: The hand model of `measured`.
        true: The true hands in the camera's frame, from `pose_hands`.
        shape: True coefficients.
        angles: True angles.
        orientation: True orientations.
        K: True intrinsics [px].
        measured: Measured errors.
        choice: Which of the `ALIKE` most similar measured hands provides the error.
    """
    frames = picture_frames(true.landmarks)
    alike = torch.cdist(looks(true.landmarks, frames), measured.looks).topk(ALIKE, largest=False).indices
    row = alike.gather(1, choice[:, None])[:, 0]
    turn = (frames.hand @ measured.turn[row][..., None])[..., 0]
    by = turn.norm(dim=1)
    wrong = from_axis_angle(turn / by.clamp_min(1e-12)[:, None], by)
    found = pose_hands(
        hand, measured.kept * shape + measured.shape[row], angles + measured.angles[row],
        wrong @ orientation, torch.zeros_like(turn),
    )  # fmt: skip
    log_focal, log_size = measured.lens[row].unbind(1)
    focal = log_focal.exp()[:, None, None]
    depth = true.landmarks[..., 2:]
    middle = depth.mean(1, keepdim=True)
    across = (frames.landmarks @ measured.place[row][..., None])[..., 0]
    rays = (true.landmarks[..., :2] / depth + across / middle) / focal
    new_depth = found.landmarks[..., 2:]
    new_depth = new_depth - new_depth.mean(1, keepdim=True) + middle * focal * log_size.exp()[:, None, None]
    shift = torch.cat([rays * new_depth, new_depth], -1) - found.landmarks
    K = K * torch.cat([focal, focal, torch.ones_like(focal)], dim=2)
    posed = found.posed + measured.shares @ shift
    return EstimatedHands(_onto_outline(posed, focal, true, measured.normals), K)


def _onto_outline(posed: Tensor, focal: Tensor, true: PosedHands, normals: Tensor) -> Tensor:
    """Move the vertices of the outline back onto the true outline; `focal` is over the true focal length."""
    out = (true.rotations @ normals[..., None])[..., 0]
    view = normalize(true.posed, dim=-1)
    rim = (1 - (normalize(out, dim=-1) * view).sum(-1, keepdim=True).abs() / _GRAZING).clamp(min=0)
    out = normalize(out[..., :2], dim=-1)
    depth = posed[..., 2:] / focal
    gap = posed[..., :2] / depth - true.posed[..., :2] / true.posed[..., 2:]
    back = rim * (gap * out).sum(-1, keepdim=True) * out * depth
    return torch.cat([posed[..., :2] - back, posed[..., 2:]], dim=-1)


PATCHES = 8
"""Number of patches along a picture's side in which mask errors vary."""
MASK_NUMBERS = 2 + 2 * PATCHES * PATCHES
"""Standard normal numbers per mask for `perturb_outline`."""
_END = (0.007, 0.0065)
"""Mean and standard deviation of the masks' end beyond the wrist point [m]."""
_GAP = 0.025
"""Half the width of the widest gap that is filled, over the picture's side."""
_GAPS = (-0.8, 1.3)
"""Mean and standard deviation of the tendency to fill gaps: in some patches of most hands, in all of few."""
_RIM = (-2.2, 0.9)
"""Mean and standard deviation of the logarithm of the outline's displacement, over the width of its blur."""
_BLUR = 5
"""Width of the outline's blur [px]; it moves by at most half of that."""


def cut_at_wrist(
    mask: Float[Tensor, "N H H"],
    alpha: Float[Tensor, "N H H"],
    landmarks: Float[Tensor, "N 21 3"],
    K: Float[Tensor, "N 3 3"],
    numbers: Float[Tensor, "N"],
    strength: float = 1.0,
) -> Float[Tensor, "N H H"]:
    """End masks at a line across the arm beyond the wrist, as `estimation.segmentation` does.

    Args:
        mask: Share of each pixel that is hand.
        alpha: Share that is hand, arm or clothes.
        landmarks: In the camera's frame [m].
        K: Intrinsics [px].
        numbers: Standard normal numbers that decide on the place.
        strength: 1 for errors as measured, 0 for none.
    """
    seen = landmarks @ K.transpose(1, 2)
    pixels = seen[..., :2] / seen[..., 2:]
    wrist, knuckles = pixels[:, 0], torch.stack([pixels[:, k] for k in KNUCKLES], 1).mean(1)
    up = normalize(knuckles - wrist, dim=-1)
    place = torch.arange(mask.shape[-1], dtype=K.dtype, device=K.device) + 0.5
    x, y = (up[:, k, None] * (place - wrist[:, k, None]) for k in (0, 1))
    past = (_END[0] + _END[1] * numbers) * K[:, 0, 0] / landmarks[:, 0, 2]
    above = (x[:, None] + y[:, :, None] + past[:, None, None] + 0.5).clamp(0, 1)
    return (mask + strength * (alpha * above - mask)).clamp(0, 1)


def perturb_outline(
    mask: Float[Tensor, "N s s"], numbers: Float[Tensor, "N M"], strength: float = 1.0
) -> Float[Tensor, "N s s"]:
    """Fill some gaps in masks of crops, and move their outlines by up to some pixels; `MASK_NUMBERS` per mask."""
    size = mask.shape[-1]
    fields = numbers[:, 2:].unflatten(1, (2, PATCHES, PATCHES))
    gaps, rim = interpolate(fields, size=(size, size), mode="bicubic", align_corners=False).unbind(1)
    filled, far = (numbers[:, k, None, None] for k in range(2))
    reach = int(_GAP * size)
    closed = -_dilate(-_dilate(mask, reach), reach)
    made = mask + (_GAPS[0] + _GAPS[1] * filled + gaps).clamp(0, 1) * (closed - mask)
    soft = avg_pool2d(made[:, None], _BLUR, 1, _BLUR // 2, count_include_pad=False)[:, 0]
    shift = ((_RIM[0] + _RIM[1] * far).exp() * rim).clamp(-0.45, 0.45)
    made = ((soft - 0.5 + shift) * _BLUR + 0.5).clamp(0, 1)
    return (mask + strength * (made - mask)).clamp(0, 1)


def _dilate(mask: Tensor, reach: int) -> Tensor:
    """Dilate by a square of 2 `reach` + 1 pixels."""
    for along in ((reach, 0), (0, reach)):
        mask = max_pool2d(mask[:, None], [2 * k + 1 for k in along], 1, along)[:, 0]
    return mask
