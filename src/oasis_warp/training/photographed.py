"""Pictures of posed hands as training batches: right hands, cropped as photos are, seen with an estimator's errors."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.rotation import from_axis_angle
from oasis_warp.core.types import TrainingBatch
from oasis_warp.hand.correctives import corrective_coefficients

CROP_MARGIN = 1.12
"""Side of a crop over the longer extent of its mask, as in `pipeline.reconstruct`."""


@runtime_checkable
class Photographed(Protocol):
    """N pictures and the truth about them: what a renderer of hands hands over.

    Camera frames throughout; the pose of a left hand describes the mirrored model (x -> -x).
    """

    @property
    def image(self) -> Float[Tensor, "N H H 3"]:
        """Colours (sRGB)."""
        ...

    @property
    def alpha(self) -> Float[Tensor, "N H H"]:
        """Share of each pixel that is not background."""
        ...

    @property
    def mask(self) -> Float[Tensor, "N H H"]:
        """Share of each pixel that is hand."""
        ...

    @property
    def angles(self) -> Float[Tensor, "N 15 3"]:
        """As `HandPose.angles`."""
        ...

    @property
    def orientation(self) -> Float[Tensor, "N 3 3"]:
        """From the hand's frame to the camera's."""
        ...

    @property
    def translation(self) -> Float[Tensor, "N 3"]:
        """Of the hand's origin [m]."""
        ...

    @property
    def shape(self) -> Float[Tensor, "N S"]:
        """Shape coefficients."""
        ...

    @property
    def K(self) -> Float[Tensor, "N 3 3"]:
        """Intrinsics [px]."""
        ...

    @property
    def left(self) -> Int[Tensor, "N"]:
        """1 for left hands."""
        ...


@dataclass(frozen=True, kw_only=True)
class EstimatorNoise:
    """How far an estimated pose is off, as standard deviations; about the errors that docs/estimator.md measures."""

    angles: float = 0.03
    """Of every joint angle [rad]."""
    turn: float = 0.015
    """Of the hand as a whole, about each axis [rad]."""
    shift: float = 0.001
    """Of its place across the view [m]."""
    shape: float = 0.15
    """Of shape coefficients."""
    crop: float = 0.02
    """Of the crop's place, over its side."""


class Posed(NamedTuple):
    """N right hands."""

    rest: Float[Tensor, "N V 3"]
    posed: Float[Tensor, "N V 3"]


def pose_hands(
    hand: HandModel,
    shape: Float[Tensor, "N S"],
    angles: Float[Tensor, "N 15 3"],
    orientation: Float[Tensor, "N 3 3"],
    translation: Float[Tensor, "N 3"],
) -> Posed:
    """`hand.skinning.rest_hand` and `skin` for many hands at once, in a fixed number of launches."""
    rest = hand.template + torch.einsum("vds,ns->nvd", hand.shape_basis, shape)
    joints = hand.joints + torch.einsum("jds,ns->njd", hand.joint_basis, shape)
    axes = hand.pose_axes[1:].expand(len(angles), -1, -1, -1)
    flexion, abduction, twist = (from_axis_angle(axes[:, :, k], angles[:, :, k]) for k in range(3))
    local = flexion @ abduction @ twist
    rotations = [orientation]
    origins = [(orientation @ joints[:, 0, :, None])[..., 0] + translation]
    for j in range(1, len(hand.parents)):
        parent = hand.parents[j]
        arm = (joints[:, j] - joints[:, parent])[..., None]
        origins.append((rotations[parent] @ arm)[..., 0] + origins[parent])
        rotations.append(rotations[parent] @ local[:, j - 1])
    rotation, origin = torch.stack(rotations, 1), torch.stack(origins, 1)
    offset = origin - (rotation @ joints[..., None])[..., 0]
    blended = torch.einsum("vj,njk->nvk", hand.weights, torch.cat([rotation.flatten(2), offset], dim=2))
    strengths = torch.vmap(lambda a: corrective_coefficients(hand, a))(angles)
    flesh = rest + torch.einsum("vdc,nc->nvd", hand.corrective_basis, strengths)
    turned = (blended[..., :9].unflatten(2, (3, 3)) * flesh[:, :, None]).sum(-1)
    return Posed(rest, turned + blended[..., 9:])


class Crops(NamedTuple):
    """Square cuts, channels last."""

    planes: Float[Tensor, "N s s C"]
    K: Float[Tensor, "N 3 3"]


def crop_to_mask(
    planes: Float[Tensor, "N H H C"],
    mask: Float[Tensor, "N H H"],
    K: Float[Tensor, "N 3 3"],
    size: int,
    jitter: Float[Tensor, "N 3"],
) -> Crops:
    """The squares round the masks as `size` pixels, bilinear; moved and grown by `jitter` (x, y, log side) of the side.

    An empty mask keeps the whole picture. Nothing waits for the device.
    """
    full = planes.shape[1]
    inside = mask > 0.5
    low, high = zip(*(_extent(inside.any(axis)) for axis in (1, 2)), strict=True)  # columns, then rows
    low, high = torch.stack(low, 1), torch.stack(high, 1)
    side = CROP_MARGIN * (high - low).amax(1, keepdim=True) * jitter[:, 2:].exp()
    corner = (low + high - side) / 2 + jitter[:, :2] * side
    cells = (torch.arange(size, dtype=K.dtype, device=K.device) + 0.5) / size
    x, y = (corner[:, k, None] + cells * side for k in range(2))
    grid = torch.stack(torch.broadcast_tensors(x[:, None], y[:, :, None]), dim=-1) * 2 / full - 1
    cut = grid_sample(planes.permute(0, 3, 1, 2), grid, align_corners=False).permute(0, 2, 3, 1)
    scale = size / side[:, 0]
    moved = K.clone()
    moved[:, :2, 2] -= corner
    moved[:, :2] *= scale[:, None, None]
    return Crops(cut, moved)


def _extent(touched: Tensor) -> tuple[Tensor, Tensor]:
    """First and one past the last true place of each row, as floats; the whole row where none is."""
    n = touched.shape[1]
    first = touched.int().argmax(1)
    last = n - touched.flip(1).int().argmax(1)
    return first.float(), last.float()


def _as_right_hands(pictures: Photographed) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Image, alpha, mask, orientation, translation and K, left hands seen in the mirror."""
    left = pictures.left.bool()

    def flip(planes: Tensor) -> Tensor:
        return torch.where(left.view(-1, *[1] * (planes.dim() - 1)), planes.flip(2), planes)

    like = pictures.translation
    sign = torch.where(left[:, None], like.new_tensor([-1.0, 1.0, 1.0]), torch.ones_like(like))
    K = pictures.K.clone()
    K[:, 0, 2] = torch.where(left, pictures.image.shape[2] - K[:, 0, 2], K[:, 0, 2])
    orientation = sign[:, :, None] * pictures.orientation * sign[:, None]
    return flip(pictures.image), flip(pictures.alpha), flip(pictures.mask), orientation, sign * like, K


@torch.no_grad()
def training_batch(
    hand: HandModel,
    photos: Photographed,
    targets: Photographed,
    size: int,
    random: torch.Generator,
    noise: EstimatorNoise = EstimatorNoise(),
) -> TrainingBatch:
    """B photos and T pictures of each one's hand, as the network is to be given them.

    Args:
        hand: On the device of the pictures.
        photos: B of them, with everything that photos have.
        targets: B T of them, those of the first hand first: what the avatar must look like, the hand alone over black.
        size: Side of the crops [px].
        random: On the CPU, of the estimator's errors; the same state gives the same batch.
        noise: Those errors; they are in `posed` and the photo's crop, nowhere else.
    """
    image, _, mask, orientation, translation, K = _as_right_hands(photos)
    count, like = len(image), translation

    def off(scale: float, *shape: int) -> Tensor:
        return scale * torch.randn(count, *shape, generator=random).to(like)

    true = pose_hands(hand, photos.shape, photos.angles, orientation, translation)
    turn = off(noise.turn, 3)
    angle = turn.norm(dim=1)
    wrong = from_axis_angle(turn / angle.clamp_min(1e-12)[:, None], angle)
    middle = true.posed.mean(1)  # an estimate turns about the hand, not about its wrist
    place = (wrong @ (translation - middle)[..., None])[..., 0] + middle
    seen = pose_hands(
        hand, photos.shape + off(noise.shape, photos.shape.shape[1]),
        photos.angles + off(noise.angles, 15, 3), wrong @ orientation, place + off(noise.shift, 3),
    )  # fmt: skip
    crop = crop_to_mask(torch.cat([image, mask[..., None]], dim=-1), mask, K, size, off(noise.crop, 3))

    views = len(targets.image) // count
    image, alpha, mask, orientation, translation, K = _as_right_hands(targets)
    goal = pose_hands(hand, targets.shape, targets.angles, orientation, translation)
    alone = image * (mask / alpha.clamp_min(1e-3)).clamp(0, 1)[..., None]  # the picture is over black already
    hidden = (alpha - mask).clamp(0, 1)
    planes = torch.cat([alone, mask[..., None], hidden[..., None]], dim=-1)
    cut = crop_to_mask(planes, mask, K, size, K.new_zeros(len(K), 3))
    still = torch.eye(4, dtype=like.dtype, device=like.device)

    def by_hand(tensor: Tensor) -> Tensor:
        return tensor.unflatten(0, (count, views))

    return TrainingBatch(
        image=crop.planes[..., :3].clamp(0, 1),
        mask=crop.planes[..., 3].clamp(0, 1),
        posed=seen.posed,
        viewmat=still.expand(count, -1, -1),
        K=crop.K,
        rest=true.rest,
        target_images=by_hand(cut.planes[..., :3].clamp(0, 1)),
        target_masks=by_hand(cut.planes[..., 3].clamp(0, 1)),
        target_known=by_hand(1 - cut.planes[..., 4].clamp(0, 1)),
        target_posed=by_hand(goal.posed),
        target_viewmats=still.expand(count, views, -1, -1),
        target_Ks=by_hand(cut.K),
    )
