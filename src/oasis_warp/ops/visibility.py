"""Soft visibility of points behind a mesh."""

from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.ops._runtime.declaration import Array, Operator, needs_gradient
from oasis_warp.ops._runtime.depth_buffer import draw, gradients
from oasis_warp.ops._runtime.depth_scene import BufferParts, DepthScene, Query
from oasis_warp.ops._runtime.incidence import checked_indices, incidence
from oasis_warp.ops.checks import check_number, check_positive
from oasis_warp.ops.depth_map import MESH_AND_CAMERA, check_picture, expand_batch

MARGIN_TAUS = 3.0
"""Default margin in units of tau: without one, half a pixel of slope hides half of the visible points."""


OR_NONE = "vertices, or -1 for none"


class DepthVisibility(NamedTuple):
    """Visibility of points and the depth buffer behind it, with a batch axis B if an argument has one.

    Without `maps`, the two maps have no rows and no columns.
    """

    visibility: Float[Tensor, "P"] | Float[Tensor, "B P"]
    """1 is seen, 0 is hidden."""
    depth_map: Float[Tensor, "H W"] | Float[Tensor, "B H W"]
    """As `DepthMap.depth`, without a gradient; in float32 within 5e-6 of it."""
    face_ids: Int[Tensor, "H W"] | Int[Tensor, "B H W"]
    """As `DepthMap.face_ids`."""


def _visibility(
    points: Tensor, vertices: Tensor, faces: Tensor, viewmats: Tensor, Ks: Tensor, point_vertices: Tensor | None,
    by_identity: bool, width: int, height: int, near_plane: float, tau: float, margin: float, maps: bool, keep: bool,
    validate: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    table = incidence("faces", faces, vertices.shape[1], "vertices").table
    scene = DepthScene(vertices, table, viewmats, Ks, width, height, near_plane)
    if point_vertices is not None:
        point_vertices = checked_indices("point_vertices", point_vertices, vertices.shape[1], OR_NONE, least=-1)
    query = Query(points, point_vertices, by_identity, tau, margin, keep)
    # The adjoint needs to know the face that each score came from.
    buffer, scores = draw(scene, query, BufferParts(maps, maps or keep, barycentrics=False), validate)
    assert scores is not None
    return scores.visibility, buffer.depth, buffer.face_ids, scores.slopes, scores.pixels


def _visibility_fake(
    points, vertices, faces, viewmats, Ks, point_vertices, by_identity, width, height, near_plane, tau, margin, maps,
    keep, validate,
):  # fmt: skip
    scene = DepthScene(vertices, faces, viewmats, Ks, width, height, near_plane)
    buffer = scene.empty_buffer(BufferParts(maps, maps or keep, barycentrics=False))
    scores = scene.empty_scores(Query(points, point_vertices, by_identity, tau, margin, keep))
    return scores.visibility, buffer.depth, buffer.face_ids, scores.slopes, scores.pixels


def _visibility_backward(
    vertices: Tensor, faces: Tensor, viewmats: Tensor, Ks: Tensor, face_ids: Tensor, slopes: Tensor, pixels: Tensor,
    near_plane: float, g_visibility: Tensor, needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    table = incidence("faces", faces, vertices.shape[1], "vertices").table
    height, width = face_ids.shape[1:]
    scene = DepthScene(vertices, table, viewmats, Ks, width, height, near_plane)
    return list(gradients(scene, face_ids, g_visibility, slopes, pixels, *needs))


def _visibility_backward_fake(vertices, faces, viewmats, Ks, face_ids, slopes, pixels, near_plane, g_visibility, needs):
    return [
        vertices.new_empty((*slopes.shape, 3) if needs[0] else 0),
        vertices.new_empty(vertices.shape if needs[1] else 0),
    ]


_OPERATOR = Operator(
    "depth_visibility",
    _visibility,
    _visibility_fake,
    _visibility_backward,
    _visibility_backward_fake,
    inputs={
        **MESH_AND_CAMERA,
        "vertices": Array("?B V 3", grad=True),
        "points": Array("?B P 3", grad=True),
        "point_vertices": Array("P", index="V", least=-1, optional=True, hint="One vertex a point, -1 for none."),
    },
    outputs={"visibility": "?B P"},
    auxiliary={"depth_map": "?B H W", "face_ids": "?B H W", "slopes": "?B P", "pixels": "?B P"},
    validates_itself=True,
    reference="visibility.depth_visibility",
)


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
    """Soft visibility of points behind a mesh: p = sigmoid((dz + margin) / tau), dz = buffered depth - point depth.

    OASIS (MM '26, eq. 4) with a margin, because a point on the visible surface itself has dz near 0 and would score
    one half. The buffer is read at the pixel that contains the point. Outside the image, or not beyond the near
    plane, p = 0; over the background p = 1; where one of the 3 x 3 pixels around the point shows a face with the
    point's own vertex as a corner, p = 1.

    Differentiable, once, in `points` and `vertices` where p is the soft score: through the depth of the point, and
    through the depth at which the ray of the pixel's centre meets the face that it shows, dz = sum b_k (n dv_k) / (n d)
    for a ray d, a face's normal n and barycentrics b_k of the hit. Which pixel and which face count as constants, as
    does the camera. The depth map carries no gradient.

    Args:
        points: Points to score [m], shape [P, 3] or a batch [B, P, 3]; P may be 0.
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
        maps: Return the depth map and its face ids too. Without them, CUDA does not write them.
        validate: Check the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once for each tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, a value that is not finite, or a `tau`, size or focal length that is
            not positive.
    """
    sizes = _OPERATOR.check(
        vertices=vertices, faces=faces, viewmat=viewmat, K=K, points=points, point_vertices=point_vertices
    )
    check_picture(width, height, near_plane)
    check_positive("tau", tau)
    margin = MARGIN_TAUS * tau if margin is None else margin
    check_number("margin", margin)
    if not 0 <= margin < float("inf"):
        raise ValueError(f"margin: expected a finite number, 0 or more, got {margin!r}.")
    batch = sizes.get("B", 1)
    keep = needs_gradient(points, vertices)
    by_identity = not literal and point_vertices is not None
    visibility, depth, face_ids, _, _ = _OPERATOR(
        expand_batch(points, batch), expand_batch(vertices, batch), faces, expand_batch(viewmat, batch),
        expand_batch(K, batch), point_vertices, by_identity, width, height, near_plane, tau,
        0.0 if literal else margin, maps, keep, validate,
    )  # fmt: skip
    if keep and not maps:
        face_ids = face_ids[:, :0, :0]
    if "B" not in sizes:
        visibility, depth, face_ids = visibility[0], depth[0], face_ids[0]
    return DepthVisibility(visibility, depth, face_ids)
