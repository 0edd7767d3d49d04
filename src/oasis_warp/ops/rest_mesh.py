"""What `face_rotations` needs of a mesh at rest, worked out once instead of for every pose."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.posing import face_rotation_native as native_kernels
from oasis_warp.core.checks import check_float, check_shape
from oasis_warp.ops._runtime.incidence import incidence
from oasis_warp.ops._runtime.launch import current_stream, has_cuda_kernels, has_vectors, run_cuda, run_native
from oasis_warp.ops._runtime.registration import operator
from oasis_warp.ops._runtime.values import check_finite
from oasis_warp.ops._runtime.words import place, pointer, task_count


class RestMesh(NamedTuple):
    """A mesh at rest, for good: no gradient goes to it."""

    vertices: Float[Tensor, "V 3"]
    triangles: Float[Tensor, "T 12"]
    """The frame and shape of every face as the kernels keep them; in float64, which has no use for them, T is 0."""


def _empty_table(rest: Tensor, faces: Tensor, *_: object) -> Tensor:
    return rest.new_empty((len(faces) if rest.dtype == torch.float32 else 0, native_kernels.TRIANGLE))


def _measure(rest: Tensor, faces: Tensor, validate: bool) -> Tensor:
    if validate:
        check_finite(rest_vertices=rest)
    corners = incidence("faces", faces, len(rest), "vertices").table
    out, rest = _empty_table(rest, faces), rest.contiguous()
    n_vertices, n_faces = len(rest), len(faces)
    if has_vectors(rest):
        state = torch.zeros(native_kernels.STATE, dtype=torch.int64)
        words = {
            "n_vertices": n_vertices,
            "n_faces": n_faces,
            "rest_vertices": place(rest, 3 * n_vertices),
            "faces": place(corners, 3 * n_faces, torch.int32),
            "state": place(state, native_kernels.STATE, torch.int64),
            "out": place(out, native_kernels.TRIANGLE * n_faces),
        }
        run_native(native_kernels.measure, words, task_count(n_faces))
    elif has_cuda_kernels(rest):
        words = {
            "n_vertices": n_vertices,
            "n_faces": n_faces,
            "rest_vertices": pointer(rest),
            "faces": pointer(corners),
            "out": pointer(out),
        }
        blocks = -(-n_faces // native_kernels.BLOCK)
        run_cuda(native_kernels.measure_triangles, words, blocks, current_stream(rest.device))
    return out


_operator = operator("rest_mesh", _measure, _empty_table)


def rest_mesh(
    rest_vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], *, validate: bool = True
) -> RestMesh:
    """A mesh at rest that is posed many times: `face_rotations` takes it in place of the rest vertices.

    Not differentiable: where rest vertices need a gradient, give them to `face_rotations` themselves.

    Args:
        rest_vertices: Vertices at rest, any unit of length, shape [V, 3], float32 or float64.
        faces: Vertex indices, shape [F, 3]; F may be 0. The same ones go to `face_rotations`.
        validate: Look at the values of the vertices too. Waits for a CUDA device: switch it off for inputs you trust.

    Raises:
        ValueError: a wrong shape, dtype or index, or a value that is not finite.
    """
    check_shape("rest_vertices", rest_vertices, "V", 3)
    check_float("rest_vertices", rest_vertices)
    check_shape("faces", faces, "F", 3, hint="Three vertex indices a face.")
    rest = rest_vertices.detach()
    return RestMesh(rest, _operator(rest, faces, validate))
