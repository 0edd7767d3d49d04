"""Gaussians on a mesh, posed by the float32 kernels of CUDA: all poses of a call in one launch."""

from collections.abc import Sequence

from torch import Tensor

from oasis_kernels.posing import mesh_gaussians as kernels
from oasis_warp.ops._runtime.launch import current_stream, run_cuda
from oasis_warp.ops._runtime.poses import summed_over_poses
from oasis_warp.ops._runtime.riders import SHARED, Floats, Riders
from oasis_warp.ops._runtime.words import aligned, pointer


def _blocks(n: int) -> int:
    return -(-n // kernels.BLOCK)


def _input_words(inputs: Floats, riders: Riders, half_powers: int) -> dict[str, int]:
    return {
        "n_vertices": riders.n_vertices,
        "n_faces": len(riders.corners.table),
        "n_on_vertices": riders.p,
        "n_on_faces": riders.q,
        "half_powers": half_powers,
        "faces": pointer(riders.corners.table),
        "vertex_index": pointer(None if riders.on_vertices is None else riders.on_vertices.table),
        "face_index": pointer(riders.on_faces.table),
        **{name: pointer(tensor) for name, tensor in inputs._asdict().items()},
    }


def _n_poses(inputs: Floats) -> int:
    return len(inputs.vertices) if inputs.vertices.ndim == 3 else 1


def pose_on_cuda(inputs: Floats, riders: Riders, half_powers: int, posed: Sequence[Tensor]) -> None:
    """Write means, quats and scales to `posed`."""
    inputs = Floats(*map(aligned, inputs))
    means, quats, scales = map(pointer, posed)
    words = _input_words(inputs, riders, half_powers) | {
        "means": means,
        "posed_quats": quats,
        "posed_scales": scales,
    }
    blocks = _n_poses(inputs) * (_blocks(riders.p) + _blocks(riders.q))
    run_cuda(kernels.pose_mesh_gaussians, words, blocks, current_stream(inputs.vertices.device))


def pose_backward_on_cuda(
    inputs: Floats, riders: Riders, half_powers: int, g_posed: Sequence[Tensor | None], g: Sequence[Tensor | None]
) -> list[Tensor | None]:
    """The gradients that are wanted, in the order of `Floats`, given those by means, quats and scales.

    They are written to the tensors of `g` but where several poses share an input; None stays None.
    """
    inputs = Floats(*map(aligned, inputs))
    n_poses, p, q, like = _n_poses(inputs), riders.p, riders.q, inputs.vertices
    batched = like.ndim == 3
    each = [
        grad.new_empty((n_poses, *grad.shape)) if shared and batched and grad is not None else grad
        for grad, shared in zip(g, SHARED, strict=True)
    ]
    by = Floats(*each)
    at_vertices = riders.at_vertices
    rows = None if at_vertices is None else like.new_empty((n_poses * (p + q), 8))
    weights = None if at_vertices is None else like.new_empty((n_poses * q, 3))
    by_ratio = None if by.area_ratio is None else like.new_empty(n_poses * q)
    given = [aligned(grad) for grad in g_posed]
    words = _input_words(inputs, riders, half_powers) | {
        "g_means": pointer(given[0]),
        "g_posed_quats": pointer(given[1]),
        "g_posed_scales": pointer(given[2]),
        "gaussian_rows": pointer(rows),
        "weights": pointer(weights),
        "by_ratio": pointer(by_ratio),
        "vertex_starts": pointer(None if at_vertices is None else at_vertices.offsets),
        "places": pointer(None if at_vertices is None else at_vertices.entries),
        "face_starts": pointer(riders.on_faces.offsets),
        "face_gaussians": pointer(riders.on_faces.entries),
        **{f"g_{name}": pointer(tensor) for name, tensor in by._asdict().items()},
    }
    stream = current_stream(like.device)
    run_cuda(kernels.pose_mesh_gaussians_backward, words, n_poses * (_blocks(p) + _blocks(q)), stream)
    blocks = (0 if rows is None else _blocks(riders.n_vertices)) + (
        0 if by.area_ratio is None else _blocks(len(riders.corners.table))
    )
    run_cuda(kernels.gather_mesh_gaussians, words, n_poses * blocks, stream)
    return [
        summed_over_poses(grad, shared and batched) if grad is not None else None
        for grad, shared in zip(each, SHARED, strict=True)
    ]
