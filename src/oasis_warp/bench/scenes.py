"""Seeded scenes to measure on: the bundled hand, surfaces of any size, and scenes that are hard to compute.

Every number is a float32 number, so that both precisions see the same scene. A scene is made on the CPU; `to` moves it.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from oasis_warp.avatar.anchors import OPACITY, THICKNESS, place_anchors, surface_frames, vertex_to_gaussians
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
"""Standard deviation of the offsets of Gaussians on vertices [m]."""
VERTEX_GAUSSIAN = 1e-3
"""Size of the Gaussians that are skinned with their vertices [m]."""
POINT_NOISE = 0.002
"""Standard deviation of the points of a mesh scene about its vertices [m]: visibility takes all values there."""

OFF_CENTER = 0.2
"""Distance of the principal point of frontal scenes from the centre [px], without which pairs of pixels were alike."""
SPREAD = 0.6
"""Standard deviation of a surfel over the root of its share of the surface: the hand's Gaussians have 0.5 to 0.7."""
UNEVEN = 0.25
"""Standard deviation of the logarithm of that."""
TILE = 8
"""Side of the tile that `one_tile` fills [px]."""

Bundle = TypeVar("Bundle", bound="TensorBundle")


def converted(value: Any, device: torch.device | str | None, dtype: torch.dtype | None) -> Any:
    """A tensor, or all tensors of a tuple or model, on another device; real numbers in another precision."""
    if isinstance(value, Tensor):
        return value.to(device=device, dtype=dtype if value.is_floating_point() else None)
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(converted(part, device, dtype) for part in value))
    return value.to(device, dtype) if isinstance(value, HandModel) else value


@dataclass(frozen=True)
class TensorBundle:
    """A dataclass of tensors, tuples of them, and plain numbers."""

    def to(self: Bundle, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Bundle:
        """The same on another device; floating-point tensors in another precision."""
        return replace(self, **{f.name: converted(getattr(self, f.name), device, dtype) for f in fields(self)})


@dataclass(frozen=True)
class GaussianScene(TensorBundle):
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

    def subset(self, index: Tensor) -> "GaussianScene":
        """The scene with the Gaussians at `index` only."""
        names = ("means", "quats", "scales", "opacities", "colors")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def views(self) -> "list[GaussianScene]":
        """A scene for each camera."""
        return [
            replace(self, viewmats=viewmat[None], Ks=K[None], backgrounds=background[None])
            for viewmat, K, background in zip(self.viewmats, self.Ks, self.backgrounds, strict=True)
        ]


@dataclass(frozen=True)
class MeshScene(TensorBundle):
    """A mesh at rest and posed, Gaussians on its vertices (P) and faces (Q), bones, points near it, and a camera."""

    name: str
    seed: int
    rest_vertices: Float[Tensor, "V 3"]
    posed_vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    vertex_quats: Float[Tensor, "V 4"]
    """This and the next two are results of `face_rotations`, rounded from float64."""
    area_ratio: Float[Tensor, "F"]
    vertex_area_ratio: Float[Tensor, "V"]
    covars: Float[Tensor, "V 3 3"]
    """Covariance of a Gaussian at each vertex [m^2]."""
    skin_weights: Float[Tensor, "V J"]
    transforms: Float[Tensor, "J 3 4"]
    """Transforms of the bones, rest to posed."""
    points: Float[Tensor, "V 3"]
    """To score by visibility: the posed vertices, moved at random."""
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

    @property
    def camera(self) -> Camera:
        """The camera as one argument."""
        return Camera(self.viewmat, self.K, self.width, self.height)


class HandParts(NamedTuple):
    """The bundled hand, open, palm to the camera, with Gaussians."""

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


def hand_scenes(size: int = 256, seed: int = 0, n_views: int = 1) -> tuple[GaussianScene, MeshScene]:
    """The bundled hand: 36,881 Gaussians over black, seen from `n_views` sides, and its mesh of 24,608 faces."""
    generator = torch.Generator().manual_seed(seed)
    hand, rest, pose, posed, canonical = hand_parts(generator)
    gaussians = pose_gaussians(canonical, hand.faces, rest.vertices, posed)
    viewmats, Ks = cameras_around(posed, size, n_views)
    drawn = GaussianScene("hand", seed, *gaussians, viewmats, Ks, torch.zeros(n_views, 3), size, size)
    points = posed + POINT_NOISE * torch.randn(posed.shape, generator=generator)
    offsets = OFFSET * torch.randn(len(canonical.vertex_index), 3, generator=generator)
    axes = VERTEX_GAUSSIAN * torch.randn(len(posed), 3, 3, generator=generator)
    rotations, translations = bone_transforms(hand, rest.joints, pose)
    mesh = MeshScene(
        "hand", seed, rest.vertices, posed, hand.faces, *mesh_rotations(rest.vertices, posed, hand.faces),
        axes @ axes.transpose(1, 2), hand.weights, torch.cat([rotations, translations[..., None]], -1), points,
        canonical.vertex_index, offsets, canonical.face_index, canonical.barycentrics, canonical.quats,
        canonical.scales, viewmats[0], Ks[0], size, size,
    )  # fmt: skip
    return drawn, mesh


def cameras_around(vertices: Float[Tensor, "V 3"], size: int, n: int) -> tuple[Tensor, Tensor]:
    """Viewmats and Ks of `n` cameras all round, the first before the palm."""
    cameras = [orbit_camera(vertices, 2 * math.pi * k / n, size=size) for k in range(n)]
    return torch.stack([camera.viewmat for camera in cameras]), torch.stack([camera.K for camera in cameras])


def mesh_rotations(rest_vertices: Tensor, posed_vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Vertex quaternions and area ratios by the float64 kernels, so that scenes do not depend on the float32 ones."""
    rotations = face_rotations(rest_vertices.double(), posed_vertices.double(), faces)
    vertex_quats, _, area_ratio, vertex_area_ratio = (part.to(rest_vertices) for part in rotations)
    return vertex_quats, area_ratio, vertex_area_ratio


def hand(size: int = 256, seed: int = 0) -> GaussianScene:
    """The Gaussians of `hand_scenes`."""
    return hand_scenes(size, seed)[0]


def surfels(n: int = 20_000, size: int = 256, seed: int = 0) -> GaussianScene:
    """`n` Gaussians of the hand, chosen at random and enlarged so that together they cover as much as all did."""
    whole = hand(size, seed)
    total = len(whole.means)
    if not 1 <= n <= total:
        raise ValueError(f"n: expected 1 to {total} Gaussians, got {n}.")
    index = torch.randperm(total, generator=torch.Generator().manual_seed(seed))[:n].sort().values
    return replace(whole.subset(index), name=f"surfels {n}", scales=whole.scales[index] * math.sqrt(total / n))


def far_hand(size: int = 256, seed: int = 0, distance: float = 100.0) -> tuple[GaussianScene, MeshScene]:
    """The hand through a long lens: `distance` metres farther away, at the same position and size in the image."""
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
) -> GaussianScene:
    """Gaussians before a camera at the origin that looks along z and sees x and y from -0.5 to 0.5 at depth 1."""
    center = size / 2 - OFF_CENTER
    K = torch.tensor([[size, 0.0, center], [0.0, size, center], [0.0, 0.0, 1.0]])
    floats = (means, quats, scales, opacities, colors)
    return GaussianScene(
        name, seed, *(part.to(torch.float32) for part in floats), torch.eye(4)[None], K[None],
        torch.tensor([[0.1, 0.2, 0.3]]), size, size,
    )  # fmt: skip


def layered(n: int = 1500, size: int = 64, seed: int = 0) -> GaussianScene:
    """A cloud of `n` small Gaussians of all opacities, some forty behind each pixel: every threshold matters."""
    g = torch.Generator().manual_seed(seed)
    depth = 1 + 2 * torch.rand(n, generator=g)
    xy = (torch.rand(n, 2, generator=g) - 0.5) * 1.1
    return frontal(
        "layered", seed, torch.cat([xy * depth[:, None], depth[:, None]], -1), torch.randn(n, 4, generator=g),
        depth[:, None] * (0.02 + 0.06 * torch.rand(n, 3, generator=g)), 0.05 + 0.9 * torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g), size,
    )  # fmt: skip


def needles(n: int = 40, size: int = 64, seed: int = 0) -> GaussianScene:
    """Gaussians 1e-4 thin that reach across the image and through depth: covariances close to singular."""
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=g) - 0.5 + torch.tensor([0.0, 0.0, 2.5])
    scales = torch.tensor([2.0, 1e-4, 1e-4]).expand(n, 3)
    return frontal(
        "needles", seed, means, torch.randn(n, 4, generator=g), scales, 0.3 + 0.6 * torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g), size,
    )  # fmt: skip


def opaque(n: int = 200, size: int = 64, seed: int = 0) -> GaussianScene:
    """Layers of opacity 0.9 to 1, each as wide as the image: most pixels end at the transmittance stop."""
    g = torch.Generator().manual_seed(seed)
    depth = 1 + torch.rand(n, generator=g)
    xy = (torch.rand(n, 2, generator=g) - 0.5) * depth[:, None]
    return frontal(
        "opaque", seed, torch.cat([xy, depth[:, None]], -1), torch.randn(n, 4, generator=g),
        0.1 + 0.2 * torch.rand(n, 3, generator=g), 0.9 + 0.1 * torch.rand(n, generator=g),
        torch.rand(n, 3, generator=g), size,
    )  # fmt: skip


def equal_depths(n: int = 300, size: int = 64, seed: int = 0) -> GaussianScene:
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
    vertex_quats, area_ratio, vertex_area_ratio = mesh_rotations(mesh.rest_vertices, posed, mesh.faces)
    return replace(
        mesh, name="slivers", posed_vertices=posed, vertex_quats=vertex_quats, area_ratio=area_ratio,
        vertex_area_ratio=vertex_area_ratio, points=posed + (mesh.points - mesh.posed_vertices),
    )  # fmt: skip


def surface(n: int, size: int = 512, n_views: int = 1, seed: int = 0) -> GaussianScene:
    """`n` surfels spread evenly over the posed hand, smaller the more there are: they cover it as densely for any n.

    Args:
        n: Gaussians.
        size: Side of the pictures [px].
        n_views: Cameras, all round.
        seed: Seed of positions, sizes and colours.
    """
    generator = torch.Generator().manual_seed(seed)
    hand, _, _, posed, _ = hand_parts(generator)
    corners = posed[hand.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ends = (normals.norm(dim=-1).double() / 2).cumsum(0)
    area = float(ends[-1])
    # One in each n-th of the surface, by area along the list of faces.
    areas = (torch.arange(n, dtype=torch.float64) + torch.rand(n, dtype=torch.float64, generator=generator)) * area / n
    face = torch.searchsorted(ends, areas).clamp_max(len(ends) - 1)
    frames = surface_frames(normalize(normals, dim=-1), corners[:, 1] - corners[:, 0])
    angle = 2 * math.pi * torch.rand(n, generator=generator)
    spread = SPREAD * math.sqrt(area / n) * torch.exp(UNEVEN * torch.randn(n, 2, generator=generator))
    viewmats, Ks = cameras_around(posed, size, n_views)
    return GaussianScene(
        f"surface {n}", seed, points_on(corners[face], generator), turned_about_z(frames[face], angle),
        torch.cat([spread, THICKNESS * spread.amin(-1, keepdim=True)], -1), torch.full((n,), OPACITY),
        torch.rand(n, 3, generator=generator), viewmats, Ks, torch.zeros(n_views, 3), size, size,
    )  # fmt: skip


def points_on(corners: Float[Tensor, "N 3 3"], generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """A random point on each triangle, all of it equally likely (Osada et al. 2002, section 4.1)."""
    root, along = torch.rand(2, len(corners), 1, generator=generator)
    root = root.sqrt()
    return (1 - root) * corners[:, 0] + root * (1 - along) * corners[:, 1] + root * along * corners[:, 2]


def turned_about_z(quats: Float[Tensor, "N 4"], angles: Float[Tensor, "N"]) -> Float[Tensor, "N 4"]:
    """Quaternions wxyz of frames turned about their own third axis [rad]."""
    w, x, y, z = quats.unbind(-1)
    c, s = (0.5 * angles).cos(), (0.5 * angles).sin()
    return torch.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], -1)


def one_tile(n: int = 100_000, size: int = 512, seed: int = 0) -> GaussianScene:
    """`n` Gaussians of a pixel each, faint, and all in one tile: nearly all of its list is drawn in every pixel."""
    generator = torch.Generator().manual_seed(seed)
    corner = size // 2 // TILE * TILE
    pixels = corner + 0.7 + (TILE - 1.4) * torch.rand(n, 2, generator=generator)
    depths = 1 + torch.rand(n, generator=generator)
    means = before_pixels(pixels, depths, size)
    return frontal(
        "one tile", seed, means, torch.randn(n, 4, generator=generator), depths[:, None] * torch.full((n, 3), 1e-5),
        torch.full((n,), 2 / 255), torch.rand(n, 3, generator=generator), size,
    )  # fmt: skip


def giants(n: int = 1000, size: int = 512, seed: int = 0) -> GaussianScene:
    """`n` Gaussians wider than the picture: every tile lists all, and they are too faint for a pixel to end early."""
    generator = torch.Generator().manual_seed(seed)
    pixels = size * torch.rand(n, 2, generator=generator)
    depths = 1 + torch.rand(n, generator=generator)
    scales = depths[:, None] * (1.5 + 0.3 * torch.rand(n, 3, generator=generator))
    scales[:, 2] *= 0.01  # flat to the view
    opacities = 0.005 + 0.004 * torch.rand(n, generator=generator)
    level = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4)
    return frontal(
        "giants", seed, before_pixels(pixels, depths, size), level, scales, opacities,
        torch.rand(n, 3, generator=generator), size,
    )  # fmt: skip


def before_pixels(pixels: Tensor, depths: Tensor, size: int) -> Tensor:
    """Points that the camera of `frontal` sees at `pixels`."""
    center = size / 2 - OFF_CENTER
    return torch.cat([(pixels - center) / size * depths[:, None], depths[:, None]], -1)


def crop(scene: GaussianScene, left: int, top: int, side: int) -> GaussianScene:
    """A square part of the first camera's picture as a picture of its own."""
    K = scene.Ks[:1].clone()
    K[:, 0, 2] -= left
    K[:, 1, 2] -= top
    return replace(
        scene, viewmats=scene.viewmats[:1], Ks=K, backgrounds=scene.backgrounds[:1], width=side, height=side
    )  # fmt: skip
