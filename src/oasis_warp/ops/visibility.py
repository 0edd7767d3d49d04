"""How visible points are past a mesh."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.core.checks import check_float, check_positive, check_shape
from oasis_warp.ops._runtime.depth_buffer import draw, gradients
from oasis_warp.ops._runtime.depth_scene import Query, Scene, Wanted
from oasis_warp.ops._runtime.incidence import incidence
from oasis_warp.ops._runtime.registration import adjoint, differentiable, needs_gradient, operator
from oasis_warp.ops.depth_map import batched, check_batched, check_scene

MARGIN_TAUS = 3.0
"""Default margin in units of tau: without one, half a pixel of slope hides half of the visible points."""


class DepthVisibility(NamedTuple):
    """Visibility of points, and the depth buffer it came from. The batch axis B is there if an argument has one.

    Without `maps`, the two maps have no rows and no columns.
    """

    visibility: Float[Tensor, "P"] | Float[Tensor, "B P"]
    """1 is seen, 0 is hidden."""
    depth_map: Float[Tensor, "H W"] | Float[Tensor, "B H W"]
    """As `DepthMap.depth`, without a gradient; in float32 within 5e-6 of it."""
    face_ids: Int[Tensor, "H W"] | Int[Tensor, "B H W"]
    """As `DepthMap.face_ids`."""


def _visibility(
    points: Tensor,
    vertices: Tensor,
    faces: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    point_vertices: Tensor | None,
    by_identity: bool,
    width: int,
    height: int,
    near_plane: float,
    tau: float,
    margin: float,
    maps: bool,
    keep: bool,
    validate: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    table = incidence("faces", faces, vertices.shape[1], "vertices").table
    scene = Scene(vertices, table, viewmats, Ks, width, height, near_plane)
    if point_vertices is not None:
        point_vertices = point_vertices.contiguous()
    query = Query(points, point_vertices, by_identity, tau, margin, keep)
    # The adjoint asks which face each score came from.
    buffer, scores = draw(scene, query, Wanted(depth=maps, face_ids=maps or keep, barycentrics=False), validate)
    assert scores is not None
    return scores.visibility, buffer.depth, buffer.face_ids, scores.slopes, scores.pixels


def _visibility_fake(
    points, vertices, faces, viewmats, Ks, point_vertices, by_identity, width, height, near_plane, tau, margin, maps,
    keep, validate,
):  # fmt: skip
    batch, n_points, _ = points.shape
    size, nothing, kept = (batch, height, width), (batch, 0, 0), (batch, n_points if keep else 0)
    return (
        points.new_empty((batch, n_points)),
        points.new_empty(size if maps else nothing),
        points.new_empty(size if maps or keep else nothing, dtype=torch.int32),
        points.new_empty(kept),
        points.new_empty(kept, dtype=torch.int32),
    )


def _visibility_backward(
    grad_visibility: Tensor,
    slopes: Tensor,
    pixels: Tensor,
    face_ids: Tensor,
    vertices: Tensor,
    faces: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    near_plane: float,
    needs_points: bool,
    needs_vertices: bool,
) -> tuple[Tensor, Tensor]:
    table = incidence("faces", faces, vertices.shape[1], "vertices").table
    height, width = face_ids.shape[1:]
    scene = Scene(vertices, table, viewmats, Ks, width, height, near_plane)
    return gradients(scene, face_ids, grad_visibility, slopes, pixels, needs_points, needs_vertices)


def _visibility_backward_fake(
    grad_visibility, slopes, pixels, face_ids, vertices, faces, viewmats, Ks, near_plane, needs_points,
    needs_vertices,
):  # fmt: skip
    nothing = vertices.new_empty(0)
    return (
        vertices.new_empty((*slopes.shape, 3)) if needs_points else nothing,
        vertices.new_empty(vertices.shape) if needs_vertices else nothing.clone(),
    )


_op = operator("depth_visibility", _visibility, _visibility_fake)
_op_backward = adjoint("depth_visibility_backward", _visibility_backward, _visibility_backward_fake)


def _save(ctx, inputs, output) -> None:
    _, vertices, faces, viewmats, Ks, _, _, _, _, near_plane, *_ = inputs
    ctx.near_plane = near_plane
    _, depth, face_ids, slopes, pixels = output
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(depth, slopes)
    ctx.save_for_backward(slopes, pixels, face_ids, vertices, faces, viewmats, Ks)


def _backward(ctx, grad_visibility, *_):
    needs_points, needs_vertices = ctx.needs_input_grad[:2]
    grad_points = grad_vertices = None
    if grad_visibility is not None:
        grad_points, grad_vertices = _op_backward(
            grad_visibility, *ctx.saved_tensors, ctx.near_plane, needs_points, needs_vertices
        )
    return (
        grad_points if needs_points else None,  # points
        grad_vertices if needs_vertices else None,  # vertices
        *[None] * 13,  # the mesh's faces, the camera and the options
    )


differentiable(_op, _backward, _save)


def depth_visibility(
    points: Float[Tensor, "P 3"] | Float[Tensor, "B P 3"],
    vertices: Float[Tensor, "V 3"] | Float[Tensor, "B V 3"],
    faces: Int[Tensor, "F 3"],
    K: Float[Tensor, "3 3"] | Float[Tensor, "B 3 3"],
    viewmat: Float[Tensor, "4 4"] | Float[Tensor, "B 4 4"],
    width: int,
    height: int,
    tau: float = 0.0015,
    margin: float | None = None,
    literal: bool = False,
    point_vertices: Int[Tensor, "P"] | None = None,
    near_plane: float = 0.01,
    *,
    maps: bool = True,
    validate: bool = True,
) -> DepthVisibility:
    """How visible points are past a mesh: p = sigmoid((dz + margin) / tau), dz = depth buffer - depth of the point.

    OASIS (MM '26, eq. 4) with a margin, because a point on the visible surface itself has dz near 0 and would score
    one half. The buffer is read at the pixel that contains the point. Outside the image, or not beyond the near
    plane, p = 0; over the background p = 1; where one of the 3 x 3 pixels round the point shows a face with the
    point's own vertex as a corner, p = 1.

    Differentiable, once, in `points` and `vertices` where p is the soft score: through the depth of the point, and
    through the depth at which the ray of the pixel's centre meets the face that it shows, dz = sum b_k (n dv_k) / (n d)
    for a ray d, a face's normal n and barycentrics b_k of the hit. Which pixel and which face count as constants, as
    does the camera. The depth map carries no gradient.

    Args:
        points: Where visibility is asked [m], shape [P, 3] or a batch [B, P, 3]; P may be 0.
        vertices: Vertices of the mesh [m], shape [V, 3] or [B, V, 3].
        faces: Vertex indices, shape [F, 3], the same for all of the batch; F may be 0.
        K: Intrinsics [px], shape [3, 3] or [B, 3, 3].
        viewmat: World to camera, shape [4, 4] or [B, 4, 4].
        width: Columns of the buffer.
        height: Rows of the buffer.
        tau: Softness of the step [m].
        margin: How far behind the buffer a point still counts as seen [m]; 3 tau when None. Keep it well below the
            thickness of what may hide a point.
        literal: Equation 4 as printed: `margin` is 0, and `point_vertices` is not used.
        point_vertices: Vertex that each point is, or -1, shape [P], the same for all of the batch.
        near_plane: Depth up to which nothing is seen [m].
        maps: Return the depth map and its face ids too. Leaving them out saves the writing of them on CUDA.
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once a tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, a value that is not finite, or a `tau`, size or focal length that is
            not positive.
    """
    sizes = check_scene(vertices, faces, viewmat, K, width, height, near_plane)
    check_batched("points", points, "P", 3, sizes=sizes)
    check_float("points", points, vertices)
    check_positive("tau", tau)
    margin = MARGIN_TAUS * tau if margin is None else margin
    if not 0 <= margin < float("inf"):
        raise ValueError(f"margin: expected a finite number, 0 or more, got {margin!r}.")
    if point_vertices is not None:
        check_shape("point_vertices", point_vertices, points.shape[-2], hint="One vertex a point, -1 for none.")
    batch = sizes.get("B", 1)
    keep = needs_gradient(points, vertices)
    visibility, depth, face_ids, _, _ = _op(
        batched(points, batch, 2),
        batched(vertices, batch, 2),
        faces,
        batched(viewmat.detach(), batch, 2),
        batched(K.detach(), batch, 2),
        point_vertices,
        not literal and point_vertices is not None,
        width,
        height,
        near_plane,
        tau,
        0.0 if literal else margin,
        maps,
        keep,
        validate,
    )
    if keep and not maps:
        face_ids = face_ids[:, :0, :0]
    if "B" not in sizes:
        visibility, depth, face_ids = visibility[0], depth[0], face_ids[0]
    return DepthVisibility(visibility, depth, face_ids)
