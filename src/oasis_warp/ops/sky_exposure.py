"""Sky exposure: how much of the light from all around reaches a surface that occludes itself."""

import functools
import math
from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import sky_exposure as kernels
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.launch import launch_ranges, vectors, view
from oasis_warp.ops.depth_map import depth_map
from oasis_warp.ops.smoothing import smooth_over_faces

N_DIRECTIONS = 32
"""Number of `sky_directions`."""
SIZE = 64
"""Side of the depth buffers [px]: 3 mm of a hand's 20 cm."""
DISTANCE = 50.0
"""Distance of their cameras, in radii of the surface: the rays are nearly parallel."""
MARGIN = 1.03
"""Radius that a buffer shows, in radii of the surface."""
FOCAL = DISTANCE * SIZE / 2
MIN_TASKS = 256
"""Vertices for which another thread is worth its while."""
LIFT = 0.002
"""Distance off the surface from which points look, and length of the ramp from seen to hidden [m]."""


class Sky(NamedTuple):
    """D directions towards the sky, which hold weighted means over the sphere to degree 9."""

    directions: Float[Tensor, "D 3"]
    """Unit. Their set is its own mirror image in each axis."""
    weights: Float[Tensor, "D"]
    """Sum to 1."""
    axes: Float[Tensor, "D 3 3"]
    """Rows: x, y and z of a camera out there that looks back."""


@functools.cache
def sky_directions(device: torch.device) -> Sky:
    """The 12 corners of the icosahedron and the 20 of the dodecahedron, with McLaren's weights of degree 9."""
    golden = (1 + math.sqrt(5)) / 2
    signs = [(i, j) for i in (-1, 1) for j in (-1, 1)]

    def rings(a: float, b: float) -> list[tuple[float, float, float]]:
        return [p for i, j in signs for p in ((0.0, i * a, j * b), (i * a, j * b, 0.0), (j * b, 0.0, i * a))]

    few, cube = rings(1.0, golden), [(i, j, k) for i, j in signs for k in (-1, 1)]
    many = [*cube, *rings(golden, 1 / golden)]
    points = torch.nn.functional.normalize(torch.tensor([*few, *many], dtype=torch.float64), dim=1)
    weights = torch.tensor([25 / 840] * len(few) + [27 / 840] * len(many))
    away = -points
    least = torch.nn.functional.one_hot(away.abs().argmin(1), 3).to(away)
    x = torch.nn.functional.normalize(torch.linalg.cross(least, away), dim=1)
    axes = torch.stack([x, torch.linalg.cross(away, x), away], 1)
    return Sky(points.float().to(device), weights.to(device), axes.float().to(device))


_SKY_EXPOSURE = Declaration(
    "sky_exposure",
    inputs={
        "vertices": Array("B V 3"), "normals": Array("B V 3"), "faces": Array("F 3", index="V"),
        "frames": Array("B 3 3"), "radiance": Array("B D 3"),
    },
    public=False,
)  # fmt: skip


@torch.no_grad()
def sky_exposure(
    vertices: Float[Tensor, "B V 3"],
    normals: Float[Tensor, "B V 3"],
    faces: Int[Tensor, "F 3"],
    frames: Float[Tensor, "B 3 3"],
    radiance: Float[Tensor, "B D 3"],
) -> Float[Tensor, "B V 4"]:
    """Share of the light from all around that reaches each vertex past the surface itself: 1 where nothing hides.

    The irradiance sum_d w_d max(0, n . d) L(d) V(d) over the same without the visibility V, from a depth buffer for
    each direction of `sky_directions`; then a mean over the faces around. Values are trusted; not differentiable. The
    same on every device and in a batch as alone up to rounding; to the bit on the CPU.

    Args:
        vertices: Vertices of posed surfaces [m], float32, [B, V, 3].
        normals: Unit, [B, V, 3].
        faces: Corners, [F, 3].
        frames: Rotations that turn the directions, [B, 3, 3]: if they turn with the surface, so does the result.
        radiance: Light L from each turned direction, red, green and blue, not negative, [B, D, 3].

    Returns:
        Shares under an even sky, then of the light's red, green and blue.

    Raises:
        ValueError: a wrong shape, type or index.
    """
    sky = sky_directions(vertices.device)
    sizes = _SKY_EXPOSURE.check(
        {"D": N_DIRECTIONS}, vertices=vertices, normals=normals, faces=faces, frames=frames, radiance=radiance
    )
    batch, n = sizes["B"], N_DIRECTIONS
    own = vertices @ frames  # in axes that turn with the surface
    middle = (own.amin(1) + own.amax(1)) / 2
    radius = MARGIN * (own - middle[:, None]).norm(dim=-1).amax(1)
    center = (frames @ middle[..., None])[..., 0]
    views = torch.zeros(batch, n, 4, 4, device=vertices.device)
    views[..., :3, :3] = axes = sky.axes @ frames.mT[:, None]
    views[..., :3, 3] = -(axes @ center[:, None, :, None])[..., 0]
    views[..., 2, 3] += DISTANCE * radius[:, None]
    views[..., 3, 3] = 1
    seen = depth_map(
        vertices[:, None].expand(-1, n, -1, -1).flatten(0, 1), faces, views.flatten(0, 1), _intrinsics(vertices.device),
        SIZE, SIZE, outputs=("depth",), validate=False,
    )  # fmt: skip
    directions = (sky.directions @ frames.mT).contiguous()
    out = vertices.new_empty(batch, sizes["V"], 4)
    inputs = [
        vectors(vertices.contiguous(), 2), vectors(normals.contiguous(), 2), vectors(directions, 2), sky.weights,
        vectors(radiance.contiguous(), 2), view(views, wp.mat44f), FOCAL, (radius * (2 / SIZE)).contiguous(),
        seen.depth.unflatten(0, (batch, n)), LIFT, vectors(out, 2),
    ]  # fmt: skip
    count = batch * sizes["V"]
    parts = max(1, min(torch.get_num_threads(), count // MIN_TASKS))
    launch_ranges(kernels.sky_exposure, [count * k // parts for k in range(parts + 1)], inputs, like=vertices)
    return smooth_over_faces(out, faces)


@functools.cache
def _intrinsics(device: torch.device) -> Float[Tensor, "3 3"]:
    """Intrinsics of the buffers' cameras; kept, because a graph must not copy them from the host."""
    return torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], device=device)
