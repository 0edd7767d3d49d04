"""What the network sees and what it says, for a batch of hands."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from oasis_warp.core.types import HandCrop, TrainingBatch


class NetworkInput(NamedTuple):
    """B square crops with the surfaces fitted to them; fields as in `TrainingBatch`."""

    image: Float[Tensor, "B S S 3"]
    mask: Float[Tensor, "B S S"]
    posed: Float[Tensor, "B V 3"]
    viewmat: Float[Tensor, "B 4 4"]
    K: Float[Tensor, "B 3 3"]
    rest: Float[Tensor, "B V 3"]


class Prediction(NamedTuple):
    """Canonical Gaussians of B hands, one for each of V vertices and then one for each of F faces; N = V + F.

    Those that the wrist's fade hides are still there, so that all hands have equally many. Without FoM F is 0.
    """

    offsets: Float[Tensor, "B V 3"]
    barycentrics: Float[Tensor, "B F 3"]
    quats: Float[Tensor, "B N 4"]
    scales: Float[Tensor, "B N 3"]
    opacities: Float[Tensor, "B N"]
    colors: Float[Tensor, "B N 3"]
    anchor_scales: Float[Tensor, "B N 3"]
    """What `scales` started from."""


def input_of_crop(crop: HandCrop) -> NetworkInput:
    """One hand as a batch of one."""
    camera = crop.camera
    parts = (
        crop.image, crop.mask, crop.posed.vertices, camera.viewmat, camera.K, crop.rest.vertices,
    )  # fmt: skip
    return NetworkInput(*(part.to(crop.image)[None] for part in parts))


def input_of_batch(batch: TrainingBatch) -> NetworkInput:
    """The photos of a training batch, without its targets."""
    return NetworkInput(*batch[: len(NetworkInput._fields)])
