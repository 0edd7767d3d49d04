"""The learned prior: the trained network's canonical Gaussians from one photo and the fitted surface."""

import functools
import hashlib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.assets import asset
from oasis_warp.avatar.anchors import MIN_OPACITY, OPACITY, RIM_FADE, batch_anchors
from oasis_warp.avatar.densify import GROUND_DEPTH, ground_discs
from oasis_warp.avatar.observation import batch_of_crop
from oasis_warp.avatar.prior import MeanPrior, Prior
from oasis_warp.core import surface
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import CanonicalGaussians, HandCrop
from oasis_warp.data.json_text import read_json
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.hand_network import Described, HandNetwork, Prediction
from oasis_warp.network.heads import ColorHeads, cache_head
from oasis_warp.network.weights_file import load_network, read_header
from oasis_warp.ops.cuda_graph import CapturedCall

RIM_FIRST, RIM_LAST = 0.5, 1.25
"""Times the length of the fade at the wrist: up to the first Gaussians have the shapes of their anchors, from the last
on those that the network gave them. Nearer than that its colours may be too dark."""


class RestSurface(NamedTuple):
    """One hand at rest: vertices [m], corners, `core.surface.faces_of_vertices`, and the vertices of the open wrist."""

    rest: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    vertex_faces: Int[Tensor, "V M"]
    rim: Int[Tensor, "R"]


def blend_rim(prediction: Prediction, on: RestSurface) -> Prediction:
    """The prediction of one hand, with anchors in the colours of the skin next to them at the wrist's end."""
    rest, faces, vertex_faces, rim = on
    count = prediction.colors.shape[1]
    from_rim = distance_from_rim(rest, faces, rim)[:count]
    share = ((from_rim / RIM_FADE - RIM_FIRST) / (RIM_LAST - RIM_FIRST)).clamp(0, 1)
    share = (share * share * (3 - 2 * share))[None, :, None]
    quats, scales, fade = (part[:, :count] for part in batch_anchors(rest[None], faces, vertex_faces, rim))
    same = torch.where((quats * prediction.quats).sum(-1, keepdim=True) < 0, -quats, quats)
    return prediction._replace(
        offsets=share[:, : len(rest)] * prediction.offsets,
        quats=normalize(torch.lerp(same, prediction.quats, share), dim=-1),
        scales=scales * (prediction.scales / scales) ** share,
        opacities=torch.lerp(OPACITY * fade, prediction.opacities, share[..., 0]),
        colors=prediction.colors[:, color_sources(rest, faces, from_rim)],
    )


MAX_SCALE, MAX_ALONG = 0.0013, 0.0025
"""Largest standard deviation of a Gaussian, and farthest from its vertex along the surface [m]. The network's vertex
Gaussians have up to 4.7 mm and lie up to 6 mm off: over other sides' outlines and between fingers they are haze."""


def clamp_to_surface(prediction: Prediction, on: RestSurface) -> Prediction:
    """The prediction with no Gaussian above the surface, far from its vertex or larger than skin can hide."""
    normals = surface.gathered_normals(*on[:3])
    above = (prediction.offsets * normals).sum(-1, keepdim=True)
    along = prediction.offsets - above * normals
    along = along * (MAX_ALONG / along.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp(max=1)
    return prediction._replace(
        offsets=along + above.clamp(max=0) * normals, scales=prediction.scales.clamp(max=MAX_SCALE)
    )


DISC_SPREAD = 1.2
"""Standard deviations of the discs below the surface over those of a vertex's anchor. With 1 skin that bends has gaps,
with 1.4 more of the discs stands out of outlines: chosen on the sides and poses of five photos of same_hand."""


def cover_surface(prediction: Prediction, on: RestSurface) -> Prediction:
    """The prediction of one hand with an opaque disc below the surface at every vertex, but for the fade at the wrist.

    Faces carry the skin; the discs, in the colours of the faces around, close its gaps where a bent finger stretches
    it. The network's own Gaussians of vertices are left out. Half of them are so faint that training never saw them,
    and all lie up to `MAX_ALONG` aside: where the skin bends more than in the photo they stand out of it, as fog around
    the knuckles of a fist. Without Gaussians on faces nothing changes.
    """
    rest, faces, vertex_faces, rim = on
    n = len(rest)
    if prediction.colors.shape[1] == n:
        return prediction
    on_faces = prediction.colors[:, n:]
    count = (vertex_faces < on_faces.shape[1]).sum(1)[:, None].clamp_min(1)
    around = surface.gather_to_vertices(on_faces, vertex_faces) / count
    quats, scales, fade = (part[:, :n] for part in batch_anchors(rest[None], faces, vertex_faces, rim))
    discs = ground_discs(DISC_SPREAD * scales)
    return prediction._replace(
        offsets=-GROUND_DEPTH * surface.gathered_normals(rest, faces, vertex_faces).expand_as(prediction.offsets),
        quats=torch.cat([quats, prediction.quats[:, n:]], 1),
        scales=torch.cat([discs, prediction.scales[:, n:]], 1),
        colors=torch.cat([around, on_faces], 1),
        opacities=torch.cat([OPACITY * fade, prediction.opacities[:, n:]], 1),
    )


def distance_from_rim(
    rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], rim: Int[Tensor, "R"]
) -> Float[Tensor, "N"]:
    """Distance of every vertex and face from the open wrist [m]."""
    at_vertices = torch.cdist(rest, rest[rim]).amin(1)
    return torch.cat([at_vertices, at_vertices[faces].amin(1)])


def color_sources(
    rest: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], from_rim: Float[Tensor, "N"]
) -> Int[Tensor, "N"]:
    """The vertex or face from which each vertex, and each face with a Gaussian, takes its colour.

    Where Gaussians fade out at the wrist, that is the nearest one that does not; `from_rim` holds their distances from
    the open wrist [m].
    """
    n, sources = len(rest), []
    for places, part in ((rest, slice(0, n)), (rest[faces].mean(1), slice(n, None))):
        away = from_rim[part]
        if len(away) == 0:
            continue
        own = torch.arange(len(away), device=away.device)
        fading, near = away < RIM_LAST * RIM_FADE, (away >= RIM_LAST * RIM_FADE) & (away < 1.5 * RIM_LAST * RIM_FADE)
        own[fading] = own[near][torch.cdist(places[fading], places[near]).argmin(1)]
        sources.append(own + (part.start or 0))
    return torch.cat(sources)


BUNDLED = ("prior", "compact.safetensors")
"""Where the weights that ship lie among the package's assets."""
UNNAMED = MappingProxyType({"name": "network"})


class NetworkPrior:
    """`avatar.prior.Prior` by a `HandNetwork`, in float32.

    On CUDA the second photo of a size is encoded by a recording of the network, as are all after it.
    """

    def __init__(self, network: HandNetwork, about: Mapping[str, str | int] = UNNAMED):
        self.network = network.eval()
        self.about = about
        self._recording: CapturedCall[Prediction] | None = None
        self._ready_for: tuple[torch.device, int] | None = None
        """Where and for which size of photos all kernels are loaded."""

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_recording": None, "_ready_for": None}  # a copy makes its own, where it is

    @torch.no_grad()
    def __call__(self, crop: HandCrop) -> CanonicalGaussians:
        """The whole hand, guessed from one photo; the network goes where the photo is."""
        return self._gaussians(self._predict(crop), crop)

    @torch.no_grad()
    def with_heads(self, crop: HandCrop) -> tuple[CanonicalGaussians, ColorHeads]:
        """The same guess, and the heads of its colours with their inputs, which LoRA trains.

        Those of vertices stay as they are: their heads would say other colours than `cover_surface`.
        """
        network, inputs = self.network.to(crop.image.device), batch_of_crop(crop)
        described = network.describe(inputs)
        guess = self._gaussians(network.decode(*described, inputs.rest), crop, covered=False)
        return guess, self._heads(guess, described, crop)

    def _heads(self, guess: CanonicalGaussians, described: Described, crop: HandCrop) -> ColorHeads:
        network, rest = self.network, crop.rest.vertices
        away = distance_from_rim(rest, network.faces, network.rim)
        rows, n = color_sources(rest, network.faces, away), len(rest)
        features, colors, seen = described.features[0], described.colors[0], described.seen
        seen = None if seen is None else seen[0]
        on_vertices = cache_head(network.vertex_head, features, colors, seen, rows[:n][guess.vertex_index])
        if network.config.fom == "off":
            return (on_vertices,)
        features, colors = network.feature_on_mesh(features[None], network.faces)[0], colors[network.faces].mean(1)
        seen = None if seen is None else seen[network.faces].mean(1)
        return on_vertices, cache_head(network.face_head, features, colors, seen, rows[n:][guess.face_index] - n)

    def _gaussians(self, prediction: Prediction, crop: HandCrop, *, covered: bool = True) -> CanonicalGaussians:
        network = self.network
        on = RestSurface(crop.rest.vertices, network.faces, network.vertex_faces, network.rim)
        clamped = clamp_to_surface(prediction, on)
        if covered:
            clamped = cover_surface(clamped, on)
        return canonical_gaussians(blend_rim(clamped, on), 0)

    def _predict(self, crop: HandCrop) -> Prediction:
        device, inputs = crop.image.device, batch_of_crop(crop)
        if device.type != "cuda" or self._ready_for != (device, len(crop.image)):
            self._ready_for, self._recording = (device, len(crop.image)), None
            return self.network.to(device)(inputs)
        if self._recording is None:
            self._recording = CapturedCall(self.network, inputs)
        return self._recording(inputs)


def guess_with_heads(prior: Prior, crop: HandCrop) -> tuple[CanonicalGaussians, ColorHeads]:
    """The guess of `prior` for one photo, and the heads that produced it.

    Raises:
        InputError: it is no network.
    """
    if not isinstance(prior, NetworkPrior):
        raise InputError(
            f"prior {prior.about['name']!r}: has no heads that LoRA can train; use a learned prior, or the field."
        )
    return prior.with_heads(crop)


def choose_prior(choice: Literal["learned", "none"] | Path, backbone_weights: Path | None = None) -> Prior:
    """The prior that `ReconstructConfig.prior` names.

    Args:
        choice: The bundled network, the mean hand, or the weights file of another network.
        backbone_weights: DINOv2's own file, where the network of the weights file reads photos with it.

    Raises:
        ValueError: a word that names no prior.
        InputError: a file that is missing, no weights file, damaged or for another hand model; or a backbone's file
            that is missing or not needed.
    """
    if isinstance(choice, Path):
        backbone = read_header(choice)["config"].get("backbone")
        if backbone_weights is not None and backbone == "convolutional":
            raise InputError(f"{choice}: does not use backbone weights; leave out --backbone-weights.")
        return NetworkPrior(
            load_network(choice, bundled_hand(), backbone_weights=backbone_weights), _identity(str(choice), choice)
        )
    if backbone_weights is not None:
        raise InputError(f"the prior {choice!r}: does not use backbone weights; leave out --backbone-weights.")
    if choice == "learned":
        return bundled_prior()
    if choice == "none":
        return MeanPrior(bundled_hand())
    raise ValueError(f"prior: expected 'learned', 'none' or a Path, got {choice!r}.")


@functools.cache
def bundled_prior() -> NetworkPrior:
    """The prior that ships with the package, trained on synthetic hands: see docs/prior.md.

    Raises:
        InputError: it is not installed.
    """
    with resources.as_file(asset(*BUNDLED)) as path:
        if not path.is_file():
            raise InputError(f"{path}: the learned prior is not installed; reinstall oasis-warp, or use --prior none.")
        return NetworkPrior(load_network(path, bundled_hand()), _identity("learned", path))


def _identity(name: str, path: Path) -> dict[str, str | int]:
    """Name and digest of a weights file, and the step of the training that wrote it where its notes say so."""
    with path.open("rb") as file:
        about: dict[str, str | int] = {"name": name, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}
    try:
        about["step"] = int(read_json(read_header(path)["notes"])["step"])
    except (KeyError, TypeError, ValueError, OverflowError):
        pass  # notes are free text
    return about


def canonical_gaussians(prediction: Prediction, hand: int) -> CanonicalGaussians:
    """The Gaussians of one hand of the batch, without those too faint to be drawn."""
    n_vertices = prediction.offsets.shape[1]
    kept = prediction.opacities[hand] >= MIN_OPACITY
    vertex_index, face_index = (torch.nonzero(part)[:, 0] for part in kept.split([n_vertices, len(kept) - n_vertices]))
    return CanonicalGaussians(
        vertex_index=vertex_index,
        offsets=prediction.offsets[hand][vertex_index],
        face_index=face_index,
        barycentrics=prediction.barycentrics[hand][face_index],
        quats=prediction.quats[hand][kept],
        scales=prediction.scales[hand][kept],
        opacities=prediction.opacities[hand][kept],
        colors=prediction.colors[hand][kept],
    )


def all_gaussians(
    prediction: Prediction, hand: int, vertex_index: Int[Tensor, "V"], face_index: Int[Tensor, "F"]
) -> CanonicalGaussians:
    """The Gaussians of one hand, the faint ones too: sizes depend on no data, and gradients reach all.

    `vertex_index` and `face_index` count all vertices and faces; the same tensors every time spare the operators a
    second look at them.
    """
    return CanonicalGaussians(
        vertex_index,
        prediction.offsets[hand],
        face_index,
        prediction.barycentrics[hand],
        prediction.quats[hand],
        prediction.scales[hand],
        prediction.opacities[hand],
        prediction.colors[hand],
    )
