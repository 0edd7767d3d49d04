"""What a camera sees of a mesh: a depth buffer with face ids, and the visibility of points against it."""

from typing import Any, NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from oasis_kernels import depth_buffer as kernels
from oasis_warp.core.checks import check_finite, check_float, check_index, check_positive, check_shape
from oasis_warp.ops._incidence import incidence
from oasis_warp.ops._launch import even_cuts, launch, launch_ranges, view

MARGIN_TAUS = 3.0
"""Default margin in units of tau: without one, half a pixel of slope hides half of the visible points."""


class DepthMap(NamedTuple):
    """The nearest surface of each pixel."""

    depth: Float[Tensor, "H W"]
    """Depth along the camera's z axis [m], +inf where there is no surface."""
    face_ids: Int[Tensor, "H W"]
    """Index of the face, -1 where there is none."""
    barycentrics: Float[Tensor, "H W 3"]
    """Weights of that face's corners at the pixel's centre, perspective correct; 0 where there is none."""


class DepthVisibility(NamedTuple):
    """Visibility of points, and the depth buffer it came from."""

    visibility: Float[Tensor, "P"]
    """1 is seen, 0 is hidden."""
    depth_map: Float[Tensor, "H W"]
    """As `DepthMap.depth`."""
    face_ids: Int[Tensor, "H W"]
    """As `DepthMap.face_ids`."""


STRIPS_A_THREAD = 3
"""Strips of the image a CPU thread: a hand covers the middle rows, and strips of one height are unequal work."""


class _Buffer(NamedTuple):
    """A filled depth buffer, in float64 whatever the inputs, and what it was made of."""

    depth: Tensor
    face_ids: Tensor
    camera_vertices: Tensor
    faces: Tensor


def _check_scene(
    vertices: Tensor,
    faces: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    near_plane: float,
    validate: bool,
) -> Tensor:
    """Check a mesh and a camera; the faces as contiguous int32."""
    check_shape("vertices", vertices, "V", 3)
    check_float("vertices", vertices)
    check_shape("faces", faces, "F", 3, hint="Three vertex indices a face.")
    check_shape("viewmat", viewmat, 4, 4, hint="World to camera.")
    check_float("viewmat", viewmat, vertices)
    check_shape("K", K, 3, 3)
    check_float("K", K, vertices)
    for name, size in (("width", width), ("height", height)):
        if size < 1:
            raise ValueError(f"{name}: expected 1 or more pixels, got {size}.")
    check_positive("near_plane", near_plane)
    if validate:
        check_finite(vertices=vertices, viewmat=viewmat, K=K)
        check_positive("K[0, 0]", float(K[0, 0]))
        check_positive("K[1, 1]", float(K[1, 1]))
    return incidence("faces", faces, len(vertices), "vertices").table


def _fill(
    vertices: Tensor, faces: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, near_plane: float
) -> _Buffer:
    device = vertices.device
    depth = torch.full((height, width), torch.inf, dtype=torch.float64, device=device)
    face_ids = torch.full((height, width), -1, dtype=torch.int32, device=device)
    camera_vertices = torch.empty(vertices.shape, dtype=torch.float64, device=device)
    boxes = torch.empty((len(faces), 4), dtype=torch.int32, device=device)
    buffer = _Buffer(depth, face_ids, camera_vertices, faces)
    if len(faces) == 0:
        return buffer

    near = wp.float64(near_plane)
    vertices_, faces_, boxes_, K_ = view(camera_vertices, wp.vec3d), view(faces), view(boxes, wp.vec4i), view(K)
    points = [view(vertices), view(viewmat), vertices_]
    launch_ranges(kernels.camera_points, even_cuts(len(vertices)), points, like=vertices)
    corners = [vertices_, faces_, K_, width, height, near, boxes_]
    launch_ranges(kernels.face_boxes, even_cuts(len(faces)), corners, like=vertices)
    fill = _fill_strips if device.type == "cpu" else _fill_faces
    fill([vertices_, faces_, boxes_, K_, near], depth, face_ids)
    return buffer


def _fill_strips(mesh: list[Any], depth: Tensor, face_ids: Tensor) -> None:
    """The way of the CPU: face after face, in strips of rows."""
    n_threads = torch.get_num_threads()
    n_strips = 1 if n_threads == 1 else min(STRIPS_A_THREAD * n_threads, len(depth))
    arguments = [n_strips, *mesh, view(depth), view(face_ids)]
    launch_ranges(kernels.fill_strips, range(n_strips + 1), arguments, like=depth)


def _fill_faces(mesh: list[Any], depth: Tensor, face_ids: Tensor) -> None:
    """The way of CUDA: all faces at once, first for the depths, then for the smallest face at that depth."""
    n_faces = mesh[1].shape[0]
    for stage in (0, 1):
        launch(kernels.fill_faces, n_faces, [stage, *mesh, view(depth), view(face_ids, wp.uint32)], like=depth)


@torch.no_grad()
def depth_map(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    *,
    validate: bool = True,
) -> DepthMap:
    """The nearest surface behind each pixel's centre, from either side; nothing here carries a gradient.

    Edges belong to both of their faces, so a closed surface has no holes; of faces at one depth the smallest index is
    kept. Faces may pass through the camera's plane (2D homogeneous rasterization, Olano and Greer 1997); a face that
    contains no pixel's centre is missed. Computed in float64, so that distance costs no digits; deterministic.

    Args:
        vertices: Vertices of the mesh [m], shape [V, 3], float32 or float64.
        faces: Vertex indices, shape [F, 3]; F may be 0. Winding does not matter.
        viewmat: World to camera (x right, y down, z forward), shape [4, 4].
        K: Intrinsics [px], shape [3, 3]; pixel centres at .5. Skew is not used.
        width: Columns of the image.
        height: Rows of the image.
        near_plane: Depth up to which surfaces are not seen [m].
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once a tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, a value that is not finite, or a size or focal length that is not
            positive.
    """
    faces = _check_scene(vertices, faces, viewmat, K, width, height, near_plane, validate)
    K = K.contiguous()
    buffer = _fill(vertices.contiguous(), faces, viewmat.contiguous(), K, width, height, near_plane)
    barycentrics = torch.zeros((height, width, 3), dtype=vertices.dtype, device=vertices.device)
    launch_ranges(
        kernels.interpolate,
        even_cuts(height, least=64),
        [view(buffer.camera_vertices, wp.vec3d), view(faces), view(K), view(buffer.face_ids), view(barycentrics)],
        like=vertices,
        lanes=width,
    )
    return DepthMap(buffer.depth.to(vertices.dtype), buffer.face_ids, barycentrics)


class _Visibility(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points, point_vertices, buffer, viewmat, K, near_plane, tau, margin):
        visibility = torch.zeros(len(points), dtype=points.dtype, device=points.device)
        slope = torch.zeros_like(visibility)
        launch_ranges(
            kernels.visibility,
            even_cuts(len(points)),
            [
                view(points),
                view(point_vertices),
                view(buffer.faces),
                view(viewmat),
                view(K),
                wp.float64(near_plane),
                wp.float64(tau),
                wp.float64(margin),
                view(buffer.depth),
                view(buffer.face_ids),
                view(visibility),
                view(slope),
            ],
            like=points,
        )
        ctx.save_for_backward(slope, viewmat)
        return visibility

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_visibility):
        slope, viewmat = ctx.saved_tensors
        return (
            (grad_visibility * slope)[:, None] * viewmat[2, :3],  # points: depth is the third row of the view
            None,  # point_vertices
            None,  # buffer
            None,  # viewmat
            None,  # K
            None,  # near_plane
            None,  # tau
            None,  # margin
        )


def depth_visibility(
    points: Float[Tensor, "P 3"],
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    K: Float[Tensor, "3 3"],
    viewmat: Float[Tensor, "4 4"],
    width: int,
    height: int,
    tau: float = 0.0015,
    margin: float | None = None,
    literal: bool = False,
    point_vertices: Int[Tensor, "P"] | None = None,
    near_plane: float = 0.01,
    *,
    validate: bool = True,
) -> DepthVisibility:
    """How visible points are past a mesh: p = sigmoid((dz + margin) / tau), dz = depth buffer - depth of the point.

    OASIS (MM '26, eq. 4) with a margin, because a point on the visible surface itself has dz near 0 and would score
    one half. The buffer is read at the pixel that contains the point. Outside the image, or not beyond the near
    plane, p = 0; over the background p = 1; where one of the 3 x 3 pixels round the point shows a face with the
    point's own vertex as a corner, p = 1.

    Differentiable in `points` through their depth; the buffer, and so `vertices` and the camera, count as constants.

    Args:
        points: Where visibility is asked [m], shape [P, 3]; P may be 0.
        vertices: Vertices of the mesh [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3]; F may be 0.
        K: Intrinsics [px], shape [3, 3].
        viewmat: World to camera, shape [4, 4].
        width: Columns of the buffer.
        height: Rows of the buffer.
        tau: Softness of the step [m].
        margin: How far behind the buffer a point still counts as seen [m]; 3 tau when None. Keep it well below the
            thickness of what may hide a point.
        literal: Equation 4 as printed: `margin` is 0, and `point_vertices` is not used.
        point_vertices: Vertex that each point is, or -1, shape [P].
        near_plane: Depth up to which nothing is seen [m].
        validate: Look at the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once a tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, a value that is not finite, or a `tau`, size or focal length that is
            not positive.
    """
    check_shape("points", points, "P", 3)
    check_float("points", points, vertices)
    faces = _check_scene(vertices, faces, viewmat, K, width, height, near_plane, validate)
    check_positive("tau", tau)
    margin = MARGIN_TAUS * tau if margin is None else margin
    if not 0 <= margin < float("inf"):
        raise ValueError(f"margin: expected a finite number, 0 or more, got {margin!r}.")
    if point_vertices is not None:
        check_shape("point_vertices", point_vertices, len(points), hint="One vertex a point, -1 for none.")
    if validate:
        check_finite(points=points)
        if point_vertices is not None:
            named = point_vertices[point_vertices != -1]
            check_index("point_vertices", named, len(vertices), "vertices, or -1 for none")
    if point_vertices is None or literal:
        point_vertices = torch.empty(0, dtype=torch.int32, device=points.device)
    with torch.no_grad():
        viewmat, K = viewmat.detach().contiguous(), K.detach().contiguous()
        buffer = _fill(vertices.detach().contiguous(), faces, viewmat, K, width, height, near_plane)
    visibility = _Visibility.apply(
        points.contiguous(),
        point_vertices.to(torch.int32).contiguous(),
        buffer,
        viewmat,
        K,
        near_plane,
        tau,
        0.0 if literal else margin,
    )
    return DepthVisibility(visibility, buffer.depth.to(points.dtype), buffer.face_ids)
