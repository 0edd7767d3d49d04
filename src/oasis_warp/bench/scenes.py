"""Seeded scenes to measure on: the bundled hand, and small ones that are hard to compute.

Every number is a float32 number, so that both precisions see the same scene. A scene is made on the CPU; `to` moves it.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import place_anchors, vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import Camera, CanonicalGaussians, HandPose, PosedHand
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import bone_transforms, rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import face_rotations

PALM_TO_CAMERA = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""Orientation of the hand, fingers up."""
HAND_GAUSSIANS = 36_881
MELANIN = 0.05
"""Skin tone of the hand."""
TEXTURE = 0.05
"""Standard deviation of the seeded noise on its colours [sRGB]: a bare mean hand has no detail to lose."""

OFFSET = 5e-4
"""Standard deviation of what Gaussians on vertices are shifted by [m]."""
VERTEX_GAUSSIAN = 1e-3
"""Size of the Gaussians that are skinned with their vertices [m]."""
POINT_NOISE = 0.002
"""Standard deviation of the points of a mesh scene about its vertices [m]: visibility takes all values there."""

Bundle = TypeVar("Bundle", bound="_Tensors")


@dataclass(frozen=True)
class _Tensors:
    """A bundle of tensors and plain numbers."""

    def to(self: Bundle, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Bundle:
        """The same on another device; floating-point tensors in another precision."""
        moved: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                moved[field.name] = value.to(device=device, dtype=dtype if value.is_floating_point() else None)
        return replace(self, **moved)


@dataclass(frozen=True)
class Scene(_Tensors):
    """Gaussians before C cameras, as `rasterization` takes them."""

    name: str
    seed: int
    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, "N"]
    colors: Float[Tensor, "N 3"]
    viewmats: Float[Tensor, "C 4 4"]
    Ks: Float[Tensor, "C 3 3"]
    backgrounds: Float[Tensor, "C 3"]
    width: int
    height: int

    def views(self) -> "list[Scene]":
        """A scene for each camera."""
        return [
            replace(self, viewmats=viewmat[None], Ks=K[None], backgrounds=background[None])
            for viewmat, K, background in zip(self.viewmats, self.Ks, self.backgrounds, strict=True)
        ]


@dataclass(frozen=True)
class MeshScene(_Tensors):
    """A mesh at rest and posed, Gaussians on its vertices (P) and faces (Q), its bones, points round it, a camera."""

    name: str
    seed: int
    rest_vertices: Float[Tensor, "V 3"]
    posed_vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    vertex_quats: Float[Tensor, "V 4"]
    """This and the next two as `face_rotations` gives them, rounded from float64."""
    area_ratio: Float[Tensor, "F"]
    vertex_area_ratio: Float[Tensor, "V"]
    covars: Float[Tensor, "V 3 3"]
    """Of a Gaussian at each vertex [m^2]."""
    skin_weights: Float[Tensor, "V J"]
    transforms: Float[Tensor, "J 3 4"]
    """Of the bones, rest to posed."""
    points: Float[Tensor, "V 3"]
    """Whose visibility is asked: the posed vertices, moved at random."""
    vertex_index: Int[Tensor, "P"]
    offsets: Float[Tensor, "P 3"]
    face_index: Int[Tensor, "Q"]
    barycentrics: Float[Tensor, "Q 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int


class HandParts(NamedTuple):
    """The bundled hand, open, palm to the camera, and what is needed to pose it."""

    hand: HandModel
    rest: PosedHand
    pose: HandPose
    posed: Float[Tensor, "V 3"]
    """Its vertices in the pose [m]."""
    canonical: CanonicalGaussians


def hand_parts(generator: torch.Generator) -> HandParts:
    """The bundled hand with 36,881 Gaussians; the generator makes the noise on their colours."""
    hand = bundled_hand()
    rest = rest_hand(hand, torch.zeros(len(hand.shape_names)))
    pose = HandPose(named_pose(hand, "open"), torch.tensor(PALM_TO_CAMERA), torch.tensor([0.0, 0.0, 0.5]))
    anchors = place_anchors(hand, rest)
    skin_colors = region_colors(label_regions(hand), MELANIN).to(torch.float32)
    skin_colors = (skin_colors + TEXTURE * torch.randn(skin_colors.shape, generator=generator)).clamp(0, 1)
    canonical = anchors.with_colors(vertex_to_gaussians(skin_colors, hand.faces, anchors))
    return HandParts(hand, rest, pose, skin(hand, rest, pose).vertices, canonical)


def hand_scenes(size: int = 256, seed: int = 0, n_views: int = 1) -> tuple[Scene, MeshScene]:
    """The bundled hand: 36,881 Gaussians over black, seen from `n_views` sides, and its mesh of 24,608 faces."""
    generator = torch.Generator().manual_seed(seed)
    hand, rest, pose, posed, canonical = hand_parts(generator)
    gaussians = pose_gaussians(canonical, hand.faces, rest.vertices, posed)
    cameras = cameras_around(posed, size, n_views)
    viewmats, Ks = (torch.stack([getattr(camera, name) for camera in cameras]) for name in ("viewmat", "K"))
    drawn = Scene("hand", seed, *gaussians, viewmats, Ks, torch.zeros(n_views, 3), size, size)
    points = posed + POINT_NOISE * torch.randn(posed.shape, generator=generator)
    offsets = OFFSET * torch.randn(len(canonical.vertex_index), 3, generator=generator)
    axes = VERTEX_GAUSSIAN * torch.randn(len(posed), 3, 3, generator=generator)
    rotations, translations = bone_transforms(hand, rest.joints, pose)
    mesh = MeshScene(
        "hand", seed, rest.vertices, posed, hand.faces, *turns(rest.vertices, posed, hand.faces),
        axes @ axes.transpose(1, 2), hand.weights, torch.cat([rotations, translations[..., None]], -1), points,
        canonical.vertex_index, offsets, canonical.face_index, canonical.barycentrics, canonical.quats,
        canonical.scales, viewmats[0], Ks[0], size, size,
    )  # fmt: skip
    return drawn, mesh


def cameras_around(vertices: Float[Tensor, "V 3"], size: int, n: int) -> list[Camera]:
    """`n` cameras all round, the first before the palm."""
    return [orbit_camera(vertices, 2 * math.pi * k / n, size=size) for k in range(n)]


def turns(rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Vertex quaternions and area ratios, the same whatever becomes of the float32 kernels."""
    turned = face_rotations(rest_vertices.double(), posed_vertices.double(), faces)
    vertex_quats, _, area_ratio, vertex_area_ratio = (part.to(rest_vertices) for part in turned)
    return vertex_quats, area_ratio, vertex_area_ratio


def hand(size: int = 256, seed: int = 0) -> Scene:
    """The Gaussians of `hand_scenes`."""
    return hand_scenes(size, seed)[0]


def surfels(n: int = 20_000, size: int = 256, seed: int = 0) -> Scene:
    """`n` Gaussians of the hand, chosen at random and enlarged so that together they cover as much as all did."""
    whole = hand(size, seed)
    total = len(whole.means)
    if not 1 <= n <= total:
        raise ValueError(f"n: expected 1 to {total} Gaussians, got {n}.")
    kept = torch.randperm(total, generator=torch.Generator().manual_seed(seed))[:n].sort().values
    return replace(
        whole,
        name=f"surfels {n}",
        means=whole.means[kept],
        quats=whole.quats[kept],
        scales=whole.scales[kept] * math.sqrt(total / n),
        opacities=whole.opacities[kept],
        colors=whole.colors[kept],
    )


def far_hand(size: int = 256, seed: int = 0, distance: float = 100.0) -> tuple[Scene, MeshScene]:
    """The hand through a long lens: `distance` metres farther away, in the same place and size on the image."""
    drawn, mesh = hand_scenes(size, seed)
    viewmat, K = mesh.viewmat.clone(), mesh.K.clone()
    depth = float((mesh.posed_vertices @ viewmat[2, :3] + viewmat[2, 3]).mean())
    viewmat[2, 3] += distance
    K[[0, 1], [0, 1]] *= (depth + distance) / depth
    return (
        replace(drawn, name="far hand", viewmats=viewmat[None], Ks=K[None]),
        replace(mesh, name="far hand", viewmat=viewmat, K=K),
    )


def frontal(
    name: str, seed: int, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, size: int
) -> Scene:
    """Gaussians before a camera at the origin that looks along z and sees x and y from -0.5 to 0.5 at depth 1."""
    center = size / 2 - 0.2  # off the pixels' grid, or pairs of pixels would be alike
    K = torch.tensor([[size, 0.0, center], [0.0, size, center], [0.0, 0.0, 1.0]])
    floats = (means, quats, scales, opacities, colors)
    return Scene(
        name, seed, *(part.to(torch.float32) for part in floats), torch.eye(4)[None], K[None],
        torch.tensor([[0.1, 0.2, 0.3]]), size, size,
    )  # fmt: skip


def layered(n: int = 1500, size: int = 64, seed: int = 0) -> Scene:
    """A cloud of `n` small Gaussians of all opacities, some forty behind each pixel: every threshold matters."""
    g = torch.Generator().manual_seed(seed)
    depth = 1 + 2 * torch.rand(n, generator=g)
    xy = (torch.rand(n, 2, generator=g) - 0.5) * 1.1
    return frontal(
        "layered", seed, torch.cat([xy * depth[:, None], depth[:, None]], -1), torch.randn(n, 4, generator=g),
        depth[:, None] * (0.02 + 0.06 * torch.rand(n, 3, generator=g)), 0.05 + 0.9 * torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g), size,
    )  # fmt: skip


def needles(n: int = 40, size: int = 64, seed: int = 0) -> Scene:
    """Gaussians 1e-4 thin that reach across the image and through depth: covariances close to singular."""
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=g) - 0.5 + torch.tensor([0.0, 0.0, 2.5])
    scales = torch.tensor([2.0, 1e-4, 1e-4]).expand(n, 3)
    return frontal(
        "needles", seed, means, torch.randn(n, 4, generator=g), scales, 0.3 + 0.6 * torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g), size,
    )  # fmt: skip


def opaque(n: int = 200, size: int = 64, seed: int = 0) -> Scene:
    """Layers of opacity 0.9 to 1, each as wide as the image: most pixels end at the transmittance stop."""
    g = torch.Generator().manual_seed(seed)
    depth = 1 + torch.rand(n, generator=g)
    xy = (torch.rand(n, 2, generator=g) - 0.5) * depth[:, None]
    return frontal(
        "opaque", seed, torch.cat([xy, depth[:, None]], -1), torch.randn(n, 4, generator=g),
        0.1 + 0.2 * torch.rand(n, 3, generator=g), 0.9 + 0.1 * torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g), size,
    )  # fmt: skip


def equal_depths(n: int = 300, size: int = 64, seed: int = 0) -> Scene:
    """Gaussians in ten planes across the view: within a plane only the index says which is in front."""
    g = torch.Generator().manual_seed(seed)
    depth = 1 + torch.randint(0, 10, (n,), generator=g) / 8
    xy = (torch.rand(n, 2, generator=g) - 0.5) * depth[:, None]
    return frontal(
        "equal depths", seed, torch.cat([xy, depth[:, None]], -1), torch.randn(n, 4, generator=g),
        0.03 + 0.09 * torch.rand(n, 3, generator=g), 0.3 + 0.6 * torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g), size,
    )  # fmt: skip


def slivers(size: int = 256, seed: int = 0) -> MeshScene:
    """The hand's mesh posed a thousand times flatter along a slanted axis: triangles become slivers."""
    _, mesh = hand_scenes(size, seed)
    axis = normalize(torch.tensor([1.0, 0.7, 0.4]), dim=0)
    middle = mesh.posed_vertices.mean(0)
    posed = mesh.posed_vertices - 0.999 * ((mesh.posed_vertices - middle) @ axis)[:, None] * axis
    vertex_quats, area_ratio, vertex_area_ratio = turns(mesh.rest_vertices, posed, mesh.faces)
    return replace(
        mesh, name="slivers", posed_vertices=posed, vertex_quats=vertex_quats, area_ratio=area_ratio,
        vertex_area_ratio=vertex_area_ratio, points=posed + (mesh.points - mesh.posed_vertices),
    )  # fmt: skip
