"""Depth buffers and scores in float32 on CUDA: four launches, their adjoint in three; nothing waits for the device.

Besides the results they need 8 bytes per pixel and 16 per face, at most 2 MiB for all faces; the adjoint 32 per vertex.
"""

from typing import Any

import torch
from torch import Tensor

from oasis_kernels.depth import depth_buffer_cuda
from oasis_kernels.depth.depth_buffer_cuda import BLOCK
from oasis_warp.ops._runtime.depth_scene import Buffer, BufferParts, DepthScene, Query, Scores, shared
from oasis_warp.ops._runtime.launch import block_count, current_stream, run_cuda

MAX_BLOCKS = 1 << 22
"""Most blocks of a launch: Warp counts threads in 32 bits. Kernels loop until all is done."""
PAIRS_PER_BLOCK = 4 * BLOCK
"""Pairs of keys that a block clears."""
BLOCKS_AT_ONCE = 3
"""Blocks that a multiprocessor holds. So many draw large faces; four times as many read the keys."""

QUERY_PARAMETERS = (
    "points", "points_step", "point_vertices", "vertex_bytes", "by_identity", "n_points", "tau", "margin", "visibility",
    "slopes", "pixels",
)  # fmt: skip


def _scene_params(scene: DepthScene) -> dict[str, Any]:
    """The parameters that all kernels share."""
    vertices, vertices_step = shared(scene.vertices)
    viewmats, viewmats_step = shared(scene.viewmats)
    Ks, Ks_step = shared(scene.Ks)
    return {
        "vertices": vertices, "viewmats": viewmats, "Ks": Ks, "faces": scene.faces, "vertices_step": vertices_step,
        "viewmats_step": viewmats_step, "Ks_step": Ks_step, "batch": len(scene.vertices), "n_faces": len(scene.faces),
        "width": scene.width, "height": scene.height,
    }  # fmt: skip


def _query_params(query: Query | None, scores: Scores | None) -> dict[str, Any]:
    if query is None or scores is None:
        return dict.fromkeys(QUERY_PARAMETERS)
    points, points_step = shared(query.points)
    known = query.point_vertices
    values = (
        points, points_step, known, 0 if known is None else known.element_size(), query.by_identity,
        query.points.shape[1], query.tau, query.margin, *scores,
    )  # fmt: skip
    return dict(zip(QUERY_PARAMETERS, values, strict=True))


def draw(
    scene: DepthScene, query: Query | None, outputs: BufferParts, found: Tensor | None = None
) -> tuple[Buffer, Scores | None]:
    """As `depth_buffer.draw`, without a check of values that costs a launch or a wait of its own.

    Args:
        scene: Meshes and cameras.
        query: Points.
        outputs: The parts to fill.
        found: Page-locked, int64: its first element becomes 1 if a focal length is not positive or a point's vertex is
            none, once the device has finished.
    """
    buffer = scene.empty_buffer(outputs)
    scores = None if query is None else scene.empty_scores(query)
    batch, n_faces, plane = len(scene.vertices), len(scene.faces), scene.width * scene.height
    stream = current_stream(scene.vertices.device)

    at_once = BLOCKS_AT_ONCE * stream.device.sm_count
    key_pairs = -(-batch * plane // 2)
    capacity = min(batch * n_faces, depth_buffer_cuda.QUEUE)
    # One allocation: keys, the queue's counter, its faces and their starts.
    scratch = torch.empty(2 * key_pairs + 2 * capacity + 2, dtype=torch.int64, device=scene.vertices.device)
    keys = scratch.data_ptr()
    counter = keys + 16 * key_pairs
    # A small image has one pixel, or less, for each thread that runs at once.
    pixels_a_thread = min(max(batch * plane // (2 * BLOCK * at_once), 1), depth_buffer_cuda.MAX_PIXELS)
    params = _scene_params(scene) | _query_params(query, scores) | buffer._asdict() | {
        "near_plane": scene.near_plane, "n_vertices": scene.vertices.shape[1], "keys": keys, "key_pairs": key_pairs,
        "counter": counter, "queue_faces": counter + 8, "queue_starts": counter + 8 + 8 * capacity,
        "capacity": capacity, "pixels_a_thread": pixels_a_thread, "found": found,
    }  # fmt: skip
    blocks = min(block_count(key_pairs, PAIRS_PER_BLOCK), MAX_BLOCKS)
    run_cuda(depth_buffer_cuda.clear, params, blocks, stream)
    blocks = min(batch * block_count(n_faces, depth_buffer_cuda.FACES_PER_BLOCK), MAX_BLOCKS)
    run_cuda(depth_buffer_cuda.draw, params, blocks, stream)
    if capacity:
        run_cuda(depth_buffer_cuda.draw_large, params, at_once, stream)
    blocks = block_count(plane, pixels_a_thread * BLOCK) if any(outputs) else 0
    blocks += 0 if query is None else block_count(query.points.shape[1], BLOCK)
    run_cuda(depth_buffer_cuda.resolve, params, min(batch * blocks, 4 * at_once, MAX_BLOCKS), stream)
    return buffer, scores


def gradients(
    scene: DepthScene, face_ids: Tensor, grad_visibility: Tensor, slopes: Tensor, pixels: Tensor, needs_points: bool,
    needs_vertices: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """As `depth_buffer.gradients`."""
    batch, n_points = slopes.shape
    n_vertices = scene.vertices.shape[1]
    grad_points = scene.empty(n_points, 3) if needs_points else scene.vertices.new_empty(0)
    grad_vertices = scene.empty(n_vertices, 3) if needs_vertices else scene.vertices.new_empty(0)
    stream = current_stream(scene.vertices.device)
    blocks = min(batch * block_count(n_points, BLOCK), depth_buffer_cuda.PEAKS)
    if needs_vertices and not blocks:
        grad_vertices.zero_()
    # One allocation: the sums at vertices, their shift, the largest numbers.
    scratch = torch.empty(
        4 * batch * n_vertices + 1 + blocks if needs_vertices else 0, dtype=torch.int64, device=slopes.device
    )
    sums = scratch.data_ptr() if needs_vertices else 0
    shift = sums + 32 * batch * n_vertices
    params = _scene_params(scene) | {
        "n_vertices": n_vertices, "n_points": n_points, "face_ids": face_ids,
        "grad_visibility": grad_visibility.contiguous(), "slopes": slopes, "pixels": pixels, "grad_points": grad_points,
        "adds": 0, "peaks": shift + 8, "shift": shift, "sums": sums,
    }  # fmt: skip
    run_cuda(depth_buffer_cuda.pull, params, blocks, stream)
    if needs_vertices and blocks:
        run_cuda(depth_buffer_cuda.pull, params | {"adds": 1}, blocks, stream)
        params = {"sums": sums, "shift": shift, "n": batch * n_vertices, "grad_vertices": grad_vertices}
        run_cuda(depth_buffer_cuda.settle, params, min(block_count(batch * n_vertices, BLOCK), MAX_BLOCKS), stream)
    return grad_points, grad_vertices
