"""Depth buffers and scores in float32 on CUDA: four launches, their adjoint in three; nothing waits for the device.

Beside the results they take 8 bytes a pixel and 16 a face, but 2 MiB for all faces at the most; the adjoint takes 32 a
vertex.
"""

import torch
from torch import Tensor

from oasis_kernels.depth import depth_buffer_cuda
from oasis_kernels.depth.depth_buffer_cuda import BLOCK
from oasis_warp.ops._runtime.depth_scene import (
    Buffer,
    Query,
    Scene,
    Scores,
    Wanted,
    empty_buffer,
    empty_scores,
    shared,
)
from oasis_warp.ops._runtime.launch import current_stream, run_cuda

MOST_BLOCKS = 1 << 22
"""Of a launch: Warp counts threads in 32 bits. Kernels go round until all is done."""
PAIRS_A_BLOCK = 4 * BLOCK
"""Pairs of keys that a block clears."""
BLOCKS_AT_ONCE = 3
"""Blocks that a multiprocessor holds. So many draw large faces; four times as many share the looking at keys."""

NO_QUERY = dict.fromkeys(
    (
        "points", "points_step", "point_vertices", "vertex_bytes", "by_identity", "n_points", "tau", "margin",
        "visibility", "slopes", "pixels",
    ),
    0,
)  # fmt: skip


def _scene_words(scene: Scene) -> tuple[dict[str, int | float], list[Tensor]]:
    """What all kernels are told, and the tensors that it points to."""
    vertices, vertices_step = shared(scene.vertices)
    viewmats, viewmats_step = shared(scene.viewmats)
    Ks, Ks_step = shared(scene.Ks)
    words: dict[str, int | float] = {
        "vertices": vertices.data_ptr(),
        "viewmats": viewmats.data_ptr(),
        "Ks": Ks.data_ptr(),
        "faces": scene.faces.data_ptr(),
        "vertices_step": vertices_step,
        "viewmats_step": viewmats_step,
        "Ks_step": Ks_step,
        "batch": len(scene.vertices),
        "n_faces": len(scene.faces),
        "width": scene.width,
        "height": scene.height,
    }
    return words, [vertices, viewmats, Ks]


def _blocks(n: int, a_block: int = BLOCK) -> int:
    return -(-n // a_block)


def draw(
    scene: Scene, query: Query | None, wanted: Wanted, found: Tensor | None = None
) -> tuple[Buffer, Scores | None]:
    """As `_depth_buffer.draw`, without a look at values that costs a launch or a wait of its own.

    Args:
        scene: Meshes and cameras.
        query: Points.
        wanted: What to write.
        found: Page-locked, int64: its first element becomes 1 if a focal length is not positive or a point's vertex is
            none, once the device is there.
    """
    buffer = empty_buffer(scene, wanted)
    scores = None if query is None else empty_scores(scene, query)
    batch, n_faces, plane = len(scene.vertices), len(scene.faces), scene.width * scene.height
    stream = current_stream(scene.vertices.device)

    at_once = BLOCKS_AT_ONCE * stream.device.sm_count
    key_pairs = -(-batch * plane // 2)
    capacity = min(batch * n_faces, depth_buffer_cuda.QUEUE)
    # One block: keys, the queue's counter, its faces and where they start.
    room = torch.empty(2 * key_pairs + 2 * capacity + 2, dtype=torch.int64, device=scene.vertices.device)
    keys = room.data_ptr()
    counter = keys + 16 * key_pairs
    scene_words, _alive = _scene_words(scene)
    scene_words |= {"near_plane": scene.near_plane, "keys": keys}
    drawn = scene_words | {
        "counter": counter,
        "queue_faces": counter + 8,
        "queue_starts": counter + 8 + 8 * capacity,
        "capacity": capacity,
    }
    blocks = min(_blocks(key_pairs, PAIRS_A_BLOCK), MOST_BLOCKS)
    found_word = 0 if found is None else found.data_ptr()
    cleared = {name: scene_words[name] for name in ("Ks", "Ks_step", "batch", "keys")}
    cleared |= {"key_pairs": key_pairs, "counter": counter, "found": found_word}
    run_cuda(depth_buffer_cuda.clear, cleared, blocks, stream)
    blocks = min(batch * _blocks(n_faces, depth_buffer_cuda.FACES_A_BLOCK), MOST_BLOCKS)
    run_cuda(depth_buffer_cuda.draw, drawn, blocks, stream)
    if capacity:
        run_cuda(depth_buffer_cuda.draw_large, drawn, at_once, stream)

    # A small picture has a pixel for each of the threads that run at once, or not even that.
    pixels_a_thread = min(max(batch * plane // (2 * BLOCK * at_once), 1), depth_buffer_cuda.MOST_PIXELS)
    blocks = _blocks(plane, pixels_a_thread * BLOCK) if any(wanted) else 0
    words = scene_words | {
        "depth": buffer.depth.data_ptr() if wanted.depth else 0,
        "face_ids": buffer.face_ids.data_ptr() if wanted.face_ids else 0,
        "barycentrics": buffer.barycentrics.data_ptr() if wanted.barycentrics else 0,
        "n_vertices": scene.vertices.shape[1],
        "pixels_a_thread": pixels_a_thread,
        "found": found_word,
    }
    if query is None or scores is None:
        words |= NO_QUERY
    else:
        points, points_step = shared(query.points)
        known = query.point_vertices
        words |= {
            "points": points.data_ptr(),
            "points_step": points_step,
            "point_vertices": 0 if known is None else known.data_ptr(),
            "vertex_bytes": 0 if known is None else known.element_size(),
            "by_identity": query.by_identity,
            "n_points": query.points.shape[1],
            "tau": query.tau,
            "margin": query.margin,
            "visibility": scores.visibility.data_ptr(),
            "slopes": scores.slopes.data_ptr() if query.keep else 0,
            "pixels": scores.pixels.data_ptr() if query.keep else 0,
        }
        blocks += _blocks(query.points.shape[1])
    run_cuda(depth_buffer_cuda.resolve, words, min(batch * blocks, 4 * at_once, MOST_BLOCKS), stream)
    return buffer, scores


def gradients(
    scene: Scene,
    face_ids: Tensor,
    grad_visibility: Tensor,
    slopes: Tensor,
    pixels: Tensor,
    needs_points: bool,
    needs_vertices: bool,
) -> tuple[Tensor, Tensor]:
    """As `_depth_buffer.gradients`."""
    batch, n_points = slopes.shape
    n_vertices = scene.vertices.shape[1]
    grad_visibility = grad_visibility.contiguous()
    grad_points = scene.room(n_points, 3) if needs_points else scene.vertices.new_empty(0)
    grad_vertices = scene.room(n_vertices, 3) if needs_vertices else scene.vertices.new_empty(0)
    stream = current_stream(scene.vertices.device)
    blocks = min(batch * _blocks(n_points), depth_buffer_cuda.PEAKS)
    if needs_vertices and not blocks:
        grad_vertices.zero_()
    # One block: the sums at vertices, their shift, the largest numbers.
    room = torch.empty(
        4 * batch * n_vertices + 1 + blocks if needs_vertices else 0, dtype=torch.int64, device=slopes.device
    )
    sums = room.data_ptr() if needs_vertices else 0
    shift = sums + 32 * batch * n_vertices
    words, _alive = _scene_words(scene)
    words |= {
        "n_vertices": n_vertices,
        "n_points": n_points,
        "face_ids": face_ids.data_ptr(),
        "grad_visibility": grad_visibility.data_ptr(),
        "slopes": slopes.data_ptr(),
        "pixels": pixels.data_ptr(),
        "grad_points": grad_points.data_ptr() if needs_points else 0,
        "adds": 0,
        "peaks": shift + 8,
        "shift": shift,
        "sums": sums,
    }
    run_cuda(depth_buffer_cuda.pull, words, blocks, stream)
    if needs_vertices and blocks:
        run_cuda(depth_buffer_cuda.pull, words | {"adds": 1}, blocks, stream)
        words = {"sums": sums, "shift": shift, "n": batch * n_vertices, "grad_vertices": grad_vertices.data_ptr()}
        run_cuda(depth_buffer_cuda.settle, words, min(_blocks(batch * n_vertices), MOST_BLOCKS), stream)
    return grad_points, grad_vertices
