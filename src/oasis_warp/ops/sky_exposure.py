"""Sky exposure: how much of the light from all around reaches a surface that occludes itself."""

import functools
import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import sky_exposure as kernels
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.incidence import checked_indices, incidence
from oasis_warp.ops._runtime.launch import block_count, contiguous, current_stream, phase_state, run_cuda, run_native


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
        "vertices": Array("B W 3"), "normals": Array("B W 3"), "members": Array("V", index="W"),
        "faces": Array("F 3", index="V"),
        "turns": Array("B 4"), "harmonics": Array("H 3"),
    },
    public=False,
)  # fmt: skip


@torch.no_grad()
def sky_exposure(
    vertices: Float[Tensor, "B W 3"],
    normals: Float[Tensor, "B W 3"],
    members: Int[Tensor, "V"],
    faces: Int[Tensor, "F 3"],
    turns: Float[Tensor, "B 4"],
    harmonics: Float[Tensor, "H 3"],
) -> Float[Tensor, "B V 4"]:
    """Share of the light from all around that reaches each vertex past the surface itself: 1 where nothing hides.

    The irradiance sum_d w_d max(0, n . d) L(d) V(d) over the same without the visibility V, from a depth buffer for
    each direction of `sky_directions`; then a mean over the faces around. Values are trusted; not differentiable. The
    same on every device and in a batch as alone up to rounding; to the bit on the CPU.

    Args:
        vertices: Vertices of posed surfaces [m], float32, [B, W, 3].
        normals: Unit, [B, W, 3].
        members: The vertices that hide the sky and look at it, int32, [V].
        faces: Corners, as numbers of `members`, [F, 3].
        turns: Unit quaternions wxyz that turn the directions, [B, 4]; as they turn with a surface, so does the result.
        harmonics: 4 or 9 harmonics of irradiance, as in `HandLight`; where the light L that they stand for is below 0,
            there is none.

    Returns:
        Shares under an even sky, then of the light's red, green and blue.

    Raises:
        ValueError: a wrong shape, type or index.
    """
    sizes = _SKY_EXPOSURE.check(
        {"H": 4 if len(harmonics) == 4 else 9},
        vertices=vertices, normals=normals, members=members, faces=faces, turns=turns, harmonics=harmonics,
    )  # fmt: skip
    batch, n, n_pairs = sizes["B"], sizes["V"], kernels.PAIRS
    index, pairs = incidence("faces", faces, n, "members"), _pairs(vertices.device)
    members = checked_indices("members", members, sizes["W"], "vertices")
    vertices, normals, turns, harmonics = contiguous(vertices, normals, turns, harmonics)
    params = pairs._asdict() | {
        "batch": batch, "n_vertices": n, "n_faces": len(faces), "vertices": vertices, "normals": normals,
        "faces": index.table, "offsets": index.offsets, "entries": index.entries, "turns": turns,
        "harmonics": harmonics, "n_harmonics": len(harmonics), "lights": vertices.new_empty(batch, n_pairs, 2, 3),
        "radius": vertices.new_empty(batch), "rough": vertices.new_empty(batch, n, 4),
        "out": vertices.new_empty(batch, n, 4),
    }  # fmt: skip
    if vertices.is_cuda:
        size, stream = kernels.SIZE, current_stream(vertices.device)
        blocks = batch * n_pairs * kernels.SLICES
        params |= {"n_points": sizes["W"], "members": members, "middle": vertices.new_empty(batch, 3)}
        params["buffers"] = vertices.new_empty(blocks, 2, size, size)
        run_cuda(kernels.draw, params, blocks if n else 0, stream)
        run_cuda(kernels.gather, params, block_count(batch * n * n_pairs, kernels.VERTEX_BLOCK), stream)
        run_cuda(kernels.smooth, params, block_count(batch * n * kernels.LANES, kernels.VERTEX_BLOCK), stream)
        return params["out"]
    params |= {name: params[name].index_select(1, members) for name in ("vertices", "normals")}
    width = -(-n // 16) * 16
    scratch = vertices.new_empty(batch, 6 + 4 * n_pairs, width)
    own, screen, shares = scratch.flatten().split([batch * rows * width for rows in (6, 3 * n_pairs, n_pairs)])
    params |= {"state": phase_state(kernels.STATE), "width": width, "own": own, "screen": screen, "shares": shares}
    run_native(kernels.expose, params, batch * n_pairs if n else 0)
    return params["out"]


class _Pairs(NamedTuple):
    """The first of each two opposite directions of the sky."""

    axes: Float[Tensor, "P 3 3"]
    weights: Float[Tensor, "P"]


@functools.cache
def _pairs(device: torch.device) -> _Pairs:
    sky = sky_directions(torch.device("cpu"))
    opposite = torch.cdist(sky.directions, -sky.directions).argmin(1)
    first = torch.arange(len(opposite)) < opposite
    return _Pairs(sky.axes[first].to(device), sky.weights[first].to(device))
