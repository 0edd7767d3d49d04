"""Square crops of fitted hands: what priors read and avatars are fitted to, with the surface that carries Gaussians."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.anchors import PRIOR_SIZE, inset_offsets
from oasis_warp.core.camera import crop_camera
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.mirror import as_right_hand
from oasis_warp.core.types import Camera, CanonicalGaussians, HandCrop, HandFit, Photo, PosedHand, SurfaceReading
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.surface_offsets import ThinSheet, outline_offsets, rendered_outline_offsets
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import chosen_hand

CROP_MARGIN = 1.12
"""Side of the crop over the longer extent of the mask."""
COARSE_SIZE = PRIOR_SIZE
"""Side of the crop that the prior reads and the whole hand is fitted to [px]: as many pixels as it has Gaussians. What
a larger one shows beyond it goes into finer Gaussians."""
SMALL_SIZE = 128
"""Side of the photo's own crop up to which a third of the Gaussians is as like the photo, or more so [px]."""
FINEST_SIZE = 1024
"""Side that is chosen for a photo at most [px]."""


class Surfaces(NamedTuple):
    """Offsets from the fitted rest surface to those that carry Gaussians [m]."""

    shared: Float[Tensor, "V 3"]
    """The avatar's, nearest to all outlines at once."""
    own: list[Float[Tensor, "V 3"]]
    """One for each photo, by which it is read: on its own outline no background gets on the hand."""
    sheets: Sequence[ThinSheet] = ()
    """With which they were found, until they are refined: those of `own`, then that of `shared` if it is another."""


def crop_side(fit: HandFit) -> float:
    """Side of the square around the hand in the photo [px]."""
    return float(square_around(fit.mask, CROP_MARGIN)[2])


def native_size(fit: HandFit) -> int:
    """Side of the crop that shows all detail of the photo, within useful bounds [px]."""
    return min(max(round(crop_side(fit)), COARSE_SIZE), FINEST_SIZE)


def is_low_resolution(config: ReconstructConfig, *fits: HandFit) -> bool:
    """Whether all photos are so small that fewer Gaussians suffice; not when `config` sets a size."""
    return config.size == "auto" and max(map(crop_side, fits)) <= SMALL_SIZE


def detail_size(fit: HandFit, config: ReconstructConfig) -> int:
    """Side of the crop with all the detail that `config` wants [px]."""
    return native_size(fit) if config.size == "auto" else config.size


def finer_size(fit: HandFit, config: ReconstructConfig) -> int | None:
    """Side of the crop whose detail goes into finer Gaussians [px]; None where the coarse ones suffice.

    In even light there is none: what the photo shows beyond the prior is not taken over.
    """
    size = detail_size(fit, config)
    return size if config.light != "even" and size > COARSE_SIZE else None


def initial_offsets(hand: HandModel, *fits: HandFit, sheet: ThinSheet | None = None) -> Float[Tensor, "V 3"]:
    """Offsets from the fitted rest surface onto the photos' outlines and then inwards [m].

    The inset suits pictures as fine as the finest of the photos. `sheet` as in `outline_offsets`.
    """
    return outline_offsets(hand, *fits, sheet=sheet) + inset_offsets(hand, max(map(native_size, fits)))


def initial_surfaces(hand: HandModel, fits: Sequence[HandFit]) -> Surfaces:
    """`initial_offsets` of all fits together and of each."""
    sheets = [ThinSheet(hand) for _ in range(len(fits) + (len(fits) > 1))]
    own = [initial_offsets(hand, fit, sheet=sheet) for fit, sheet in zip(fits, sheets, strict=False)]
    return Surfaces(own[0] if len(own) == 1 else initial_offsets(hand, *fits, sheet=sheets[-1]), own, sheets)


def refine_surfaces(
    hand: HandModel, photos: Sequence[Photo], fits: Sequence[HandFit], surfaces: Surfaces,
    guesses: Sequence[CanonicalGaussians], config: ReconstructConfig,
) -> Surfaces:  # fmt: skip
    """Move the surfaces until the prior's guesses, drawn on them, have the outlines of their photos."""

    def refined(offsets: Tensor, sheet: ThinSheet, *indices: int) -> Tensor:
        crops = [crop_hand(photos[k], fits[k], offsets, config, detail_size(fits[k], config)) for k in indices]
        return offsets + rendered_outline_offsets(hand, [guesses[k] for k in indices], crops, sheet).cpu()

    sheets = surfaces.sheets
    own = [refined(offsets, sheets[k], k) for k, offsets in enumerate(surfaces.own)]
    return Surfaces(own[0] if len(own) == 1 else refined(surfaces.shared, sheets[-1], *range(len(photos))), own)


def crop_hand(
    photo: Photo, fit: HandFit, offsets: torch.Tensor, config: ReconstructConfig, size: int | None = None
) -> HandCrop:
    """The square crop that avatars are fitted to, with the fitted surface in its camera; a left hand is mirrored.

    Args:
        photo: The photo.
        fit: Fit of its hand.
        offsets: From the fitted rest surface to the one that carries Gaussians [m].
        config: Size, device and the hand model of `fit`.
        size: Side of the crop [px]; if not given, what `config` wants, up to `COARSE_SIZE`.

    Raises:
        InputError: the mask is empty.
    """
    hand = chosen_hand(config.hand_model, config.mano_dir)
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

    def on_device(surface: PosedHand) -> PosedHand:
        return PosedHand(*(part.to(device) for part in surface))

    def resample(plane: Tensor) -> Tensor:
        return resample_square(plane.contiguous(), left, top, side, size).clamp(0, 1).to(device)

    return HandCrop(
        image=resample(image),
        mask=resample(mask),
        above_wrist=resample(above),
        camera=crop._replace(viewmat=crop.viewmat.to(device), K=crop.K.to(device)),
        rest=on_device(rest),
        posed=on_device(posed),
        reading=None if right.reading is None else _resampled_reading(right.reading, left, top, side, size).to(device),
    )


def _resampled_reading(
    reading: SurfaceReading, left: float, top: float, side: float, size: int
) -> Float[Tensor, "S S 7"]:
    """`HandCrop.reading`, by the nearest sample: the mean of the places on two fingers is no place."""
    planes = torch.cat([reading.places, reading.spread[..., None], reading.albedo], -1)
    steps = (torch.arange(size, dtype=torch.float64) + 0.5) / size * side
    starts = top - reading.top, left - reading.left
    near = [((start + steps) / reading.side * len(planes)).floor().long() for start in starts]
    rows, columns = (index.clamp(0, len(planes) - 1) for index in near)
    read = planes[rows][:, columns]
    inside = (near[0] == rows)[:, None] & (near[1] == columns)
    read[..., 3] = torch.where(inside, read[..., 3], torch.inf)
    return read


def crop_hands(
    photos: Sequence[Photo], fits: Sequence[HandFit], surfaces: Surfaces, config: ReconstructConfig, *,
    finer: bool = False,
) -> list[HandCrop]:  # fmt: skip
    """Crops of all photos, each on its own surface in its pose, with the shared surface at rest.

    All have one size, or with `finer` each that of its detail, if that is larger.
    """
    plain = rest_hand(chosen_hand(config.hand_model, config.mano_dir), fits[0].shape)
    shared = plain._replace(vertices=plain.vertices + surfaces.shared)
    crops = []
    for photo, fit, own in zip(photos, fits, surfaces.own, strict=True):
        crop = crop_hand(photo, fit, own, config, finer_size(fit, config) if finer else None)
        crops.append(crop._replace(rest=PosedHand(*(part.to(crop.image) for part in shared))))
    return crops


def resolutions(fits: Sequence[HandFit], crops: Sequence[HandCrop]) -> list[float]:
    """Pixels of each photo for one pixel of its crop, along a line."""
    return [float(fit.camera.K[0, 0] / crop.camera.K[0, 0]) for fit, crop in zip(fits, crops, strict=True)]


def crop_landmarks(fit: HandFit, crop: Camera) -> Float[Tensor, "21 2"]:
    """The fit's landmarks in the crop of its hand [px]; those of a left hand are mirrored."""
    right, K = as_right_hand(fit), crop.K.cpu()
    own = right.camera.K
    return (right.landmarks.xy - own[:2, 2]) * K.diagonal()[:2] / own.diagonal()[:2] + K[:2, 2]
