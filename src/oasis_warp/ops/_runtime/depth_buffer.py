"""Draw meshes into depth buffers and score points against them.

On the CPU by vectorised kernels, on CUDA in float32 by those of `depth_cuda`, in float64 by the generic ones.
"""

import ctypes

import torch
import warp as wp
from torch import Tensor

from oasis_kernels.depth import depth_buffer as kernels
from oasis_kernels.depth import depth_buffer_native as vectors
from oasis_kernels.depth.depth_buffer_native import (
    POINTS_PER_TASK,
    QUADS_PER_TASK,
    SPARE_COLUMNS,
    VERTICES_PER_TASK,
    Job,
)
from oasis_warp.core.processes import kernel_threads
from oasis_warp.ops._runtime import depth_cuda
from oasis_warp.ops._runtime.depth_scene import Buffer, BufferParts, DepthScene, Query, Scores, restrict, shared
from oasis_warp.ops._runtime.incidence import _transposed, sum_at_items
from oasis_warp.ops._runtime.launch import SCALAR_NAMES, launch, run_shared, view
from oasis_warp.ops._runtime.pair_counts import thread_slot
from oasis_warp.ops._runtime.values import DeferredFiniteCheck, check_finite
from oasis_warp.ops.checks import check_positive

Drawn = tuple[Buffer, Scores | None]
MAX_FRACTION_BITS = 22
FACES_PER_PART = 4096
"""A mesh is drawn in parts, one per thread, of at least this many faces."""


def draw(scene: DepthScene, query: Query | None, outputs: BufferParts, validate: bool) -> Drawn:
    """Fill the depth buffers and score the points, if any.

    Raises:
        ValueError: with `validate`, a value that is not finite, or a focal length that is not positive.
    """
    if scene.vertices.device.type == "cpu":
        return draw_by_vectors(scene, query, outputs, validate)
    method = draw_by_keys if scene.vertices.dtype == torch.float32 else draw_by_faces
    return method(scene, query, outputs, validate)


def refuse_bad_values(scene: DepthScene, query: Query | None) -> None:
    """Refuse values that are not finite, and focal lengths that are not positive."""
    check_finite(vertices=scene.vertices, viewmat=scene.viewmats, K=scene.Ks)
    for i in (0, 1):
        focal = scene.Ks[:, i, i]
        check_positive(f"K[{i}, {i}]", float(focal.min()) if len(focal) else 1.0)
    if query is not None:
        check_finite(points=query.points)


def plane_size(width: int, height: int) -> int:
    """Numbers in a plane of blocks of 4 x 4 pixels."""
    columns = -(-(width + SPARE_COLUMNS) // 16) * 16
    return -(-height // 4) * 4 * columns


def _fraction_bits(width: int, height: int) -> int:
    """Bits after the point of coordinates on the screen that reach half a picture beyond its borders in 31 bits."""
    return min(MAX_FRACTION_BITS, 30 - (max(width, height) - 1).bit_length())


def _job(scene: DepthScene, **more: int) -> tuple[Job, list[Tensor]]:
    """A job for `scene`, and the tensors it points to, which must outlive it; `more` are further fields."""
    vertices, vertices_step = shared(scene.vertices)
    viewmats, viewmats_step = shared(scene.viewmats)
    Ks, Ks_step = shared(scene.Ks)
    job = Job(
        vertices=vertices.data_ptr(), viewmats=viewmats.data_ptr(), Ks=Ks.data_ptr(), faces=scene.faces.data_ptr(),
        vertices_step=vertices_step, viewmats_step=viewmats_step, Ks_step=Ks_step, batch=scene.vertices.shape[0],
        n_vertices=scene.vertices.shape[1], n_faces=scene.faces.shape[0], width=scene.width, height=scene.height,
        fraction_bits=_fraction_bits(scene.width, scene.height), near_plane=scene.near_plane, **more,
    )  # fmt: skip
    return job, [vertices, viewmats, Ks]


def draw_by_vectors(scene: DepthScene, query: Query | None, outputs: BufferParts, validate: bool) -> Drawn:
    """`draw` on the CPU."""
    batch, n_vertices, _ = scene.vertices.shape
    width, height = scene.width, scene.height
    parts = max(1, min(-(-kernel_threads() // max(batch, 1)), scene.faces.shape[0] // FACES_PER_PART))
    drawn = outputs._replace(depth=True, face_ids=True)
    buffer = scene.empty_buffer(drawn)
    # One allocation: camera_vertices, screen_vertices and planes, in numbers of 4 bytes.
    scratch = scene.empty(12 * n_vertices + 2 * parts * plane_size(width, height), dtype=torch.float32)
    first = scratch.data_ptr()
    job, _alive = _job(
        scene, camera_vertices=first, screen_vertices=first + 32 * batch * n_vertices,
        planes=first + 48 * batch * n_vertices, parts=parts, depth=buffer.depth.data_ptr(),
        face_ids=buffer.face_ids.data_ptr(),
        barycentrics=buffer.barycentrics.data_ptr() if outputs.barycentrics else 0,
    )  # fmt: skip
    scores = None
    if query is not None:
        points, job.points_step = shared(query.points)
        job.n_points = query.points.shape[1]
        scores = scene.empty_scores(query)
        named = query.point_vertices
        job.points = points.data_ptr()
        job.point_vertices = 0 if named is None else named.data_ptr()
        job.identity = query.by_identity
        job.tau, job.margin = query.tau, query.margin
        job.visibility = scores.visibility.data_ptr()
        if query.keep:
            job.slopes, job.pixels = scores.slopes.data_ptr(), scores.pixels.data_ptr()
    _run_all(job, SCALAR_NAMES[scene.vertices.dtype])
    # Bad values do no harm before they are refused.
    if validate and job.found:
        refuse_bad_values(scene, query)
    return (buffer if drawn == outputs else restrict(buffer, outputs)), scores


def _run_all(job: Job, dtype: str) -> None:
    """Run the stages of a forward pass on as many of our threads as they have tasks for."""
    if kernel_threads() == 1:
        _run("all", dtype, job, 1)
        return
    _run("transform", dtype, job, -(-job.n_vertices // VERTICES_PER_TASK))
    _run("draw", dtype, job, job.parts)
    _run("write", dtype, job, -(-job.height // (4 * QUADS_PER_TASK)))
    _run("score", dtype, job, -(-job.n_points // POINTS_PER_TASK))


def _run(stage: str, dtype: str, job: Job, tasks: int) -> None:
    """Run a stage that has a number of tasks for each batch entry."""
    run_shared(getattr(vectors.kernels(dtype), stage), ctypes.addressof(job), job.batch * tasks)


def draw_by_keys(scene: DepthScene, query: Query | None, outputs: BufferParts, validate: bool) -> Drawn:
    """`draw` on CUDA in float32."""
    if not validate:
        return depth_cuda.draw(scene, query, outputs)
    points = None if query is None else query.points
    with DeferredFiniteCheck(vertices=scene.vertices, viewmat=scene.viewmats, K=scene.Ks, points=points):
        found = thread_slot()
        found[0] = 0
        drawn = depth_cuda.draw(scene, query, outputs, found)
    # Bad values do no harm before they are refused.
    if found[0]:
        refuse_bad_values(scene, query)
    return drawn


def draw_by_faces(scene: DepthScene, query: Query | None, outputs: BufferParts, validate: bool) -> Drawn:
    """`draw` by the generic kernels: all faces at once, first for depths, then for the smallest face at each depth."""
    if validate:
        refuse_bad_values(scene, query)
    batch, n_vertices, _ = scene.vertices.shape
    n_faces, width, height = len(scene.faces), scene.width, scene.height
    like = scene.vertices
    viewmats, Ks = scene.viewmats.contiguous(), scene.Ks.contiguous()
    depth = scene.empty(height, width, dtype=torch.float64).fill_(torch.inf)
    face_ids = scene.empty(height, width, dtype=torch.int32).fill_(-1)
    camera_vertices = scene.empty(n_vertices, 3, dtype=torch.float64)
    boxes = view(scene.empty(n_faces, 4, dtype=torch.int32), wp.vec4i)
    vertices, faces, near = view(camera_vertices, wp.vec3d), scene.faces, wp.float64(scene.near_plane)
    launch(kernels.camera_points, (batch, n_vertices), [scene.vertices.contiguous(), viewmats, vertices], like=like)
    launch(kernels.face_boxes, (batch, n_faces), [vertices, faces, Ks, width, height, near, boxes], like=like)
    for stage in (0, 1):
        inputs = [stage, vertices, faces, boxes, Ks, near, depth, view(face_ids, wp.uint32)]
        launch(kernels.fill_faces, (batch, n_faces), inputs, like=like)
    weights = scene.empty(height, width, 3).zero_()
    if outputs.barycentrics:
        launch(kernels.interpolate, (batch, height, width), [vertices, faces, Ks, face_ids, weights], like=like)
    buffer = restrict(Buffer(depth.to(like.dtype), face_ids, weights), outputs)
    return buffer, None if query is None else _score_points(scene, query, depth, face_ids)


def _score_points(scene: DepthScene, query: Query, depth: Tensor, face_ids: Tensor) -> Scores:
    """Scores by the generic kernel, given the buffers."""
    known = query.point_vertices if query.by_identity else None
    scores = scene.empty_scores(query)
    scores.visibility.zero_()
    scores.slopes.zero_()
    scores.pixels.fill_(-1)
    inputs = [
        query.points.contiguous(), face_ids.new_empty(0) if known is None else known, scene.faces,
        scene.viewmats.contiguous(), scene.Ks.contiguous(), wp.float64(scene.near_plane), wp.float64(query.tau),
        wp.float64(query.margin), depth, face_ids, *scores,
    ]  # fmt: skip
    launch(kernels.visibility, query.points.shape[:2], inputs, like=scene.vertices)
    return scores


def gradients(
    scene: DepthScene, face_ids: Tensor, grad_visibility: Tensor, slopes: Tensor, pixels: Tensor, needs_points: bool,
    needs_vertices: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Gradients of scores by the points, [B, P, 3], and by the vertices of the faces in their pixels, [B, V, 3].

    Sums have a fixed order, or none. What is not needed has no elements.
    """
    on_cuda = slopes.device.type != "cpu"
    if on_cuda and slopes.dtype == torch.float32:
        return depth_cuda.gradients(scene, face_ids, grad_visibility, slopes, pixels, needs_points, needs_vertices)
    by_points, by_vertices = slopes.new_empty(0), slopes.new_empty(0)
    if needs_points:
        # The point's depth is the third row of the view.
        by_points = (grad_visibility * slopes)[..., None] * scene.viewmats[:, None, 2, :3]
    if needs_vertices:
        method = vertex_gradients_by_points if on_cuda else vertex_gradients_by_vectors
        by_vertices = method(scene, face_ids, grad_visibility.contiguous(), slopes, pixels)
    return by_points, by_vertices


def vertex_gradients_by_vectors(
    scene: DepthScene, face_ids: Tensor, grad_visibility: Tensor, slopes: Tensor, pixels: Tensor
) -> Tensor:
    """Gradients by vertices on the CPU: point after point."""
    batch, n_vertices, _ = scene.vertices.shape
    grad_vertices = scene.empty(n_vertices, 3)
    # One allocation: camera_vertices, sums and screen_vertices, in numbers of 8 bytes.
    scratch = scene.empty(9 * n_vertices, dtype=torch.float64)
    first = scratch.data_ptr()
    job, _alive = _job(
        scene, n_points=slopes.shape[1], camera_vertices=first, sums=first + 32 * batch * n_vertices,
        screen_vertices=first + 56 * batch * n_vertices, face_ids=face_ids.data_ptr(),
        grad_visibility=grad_visibility.data_ptr(), slopes=slopes.data_ptr(), pixels=pixels.data_ptr(),
        grad_vertices=grad_vertices.data_ptr(),
    )  # fmt: skip
    dtype = SCALAR_NAMES[slopes.dtype]
    _run("transform", dtype, job, -(-n_vertices // VERTICES_PER_TASK))
    _run("pull", dtype, job, 1)
    return grad_vertices


def vertex_gradients_by_points(
    scene: DepthScene, face_ids: Tensor, grad_visibility: Tensor, slopes: Tensor, pixels: Tensor
) -> Tensor:
    """Gradients by vertices by the generic kernels: all points at once, then sums over the points of each vertex."""
    batch, n_points = slopes.shape
    n_vertices = scene.vertices.shape[1]
    rows = scene.empty(n_points, 3, 3)
    tensors = grad_visibility, slopes, pixels, face_ids, scene.vertices, scene.faces, scene.viewmats, scene.Ks, rows
    launch(kernels.corner_gradients, (batch, n_points), [t.contiguous() for t in tensors], like=slopes)
    # Scores that are not soft name the first vertex, with rows of zeros.
    seen = face_ids.flatten(1).gather(1, pixels.clamp_min(0).long()).where(pixels >= 0, 0)
    corners = scene.faces[seen.long()] if len(scene.faces) else scene.faces.new_zeros((batch, n_points, 3))
    corners = corners + n_vertices * torch.arange(batch, device=corners.device, dtype=torch.int32)[:, None, None]
    # Not `incidence`, which would look at the indices and so wait for the device.
    return sum_at_items(rows.view(-1, 3), _transposed(corners, batch * n_vertices)).view_as(scene.vertices)
