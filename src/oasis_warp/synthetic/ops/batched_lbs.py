"""Skin the hands of different people: correctives and knuckles on each one's resting surface, then blended bones."""

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.skinning import batched_lbs as kernels
from oasis_warp.core.checks import check_shape
from oasis_warp.ops._runtime.launch import even_cuts, launch_ranges, view
from oasis_warp.ops._runtime.registration import operator


def _pose(
    rest: Tensor, displacements: Tensor, strengths: Tensor, normals: Tensor, rises: Tensor, knuckles: Tensor,
    weights: Tensor, rotations: Tensor, shifts: Tensor,
) -> Tensor:  # fmt: skip
    out = torch.empty_like(rest, memory_format=torch.contiguous_format)
    vec3 = lambda t: view(t.contiguous(), wp.vec3f)  # noqa: E731
    inputs = [
        vec3(rest), view(displacements.contiguous()), view(strengths.contiguous()), vec3(normals),
        view(rises.contiguous()), view(knuckles.contiguous()), view(weights.contiguous()),
        view(rotations.contiguous(), wp.mat33f), vec3(shifts), view(out, wp.vec3f),
    ]  # fmt: skip
    launch_ranges(kernels.batched_lbs, even_cuts(rest.shape[0] * rest.shape[1]), inputs, like=rest)
    return out


def _pose_fake(rest: Tensor, *_: Tensor) -> Tensor:
    return torch.empty_like(rest, memory_format=torch.contiguous_format)


_op = operator("batched_lbs", _pose, _pose_fake)


@torch.no_grad()
def batched_lbs(
    rest: Float[Tensor, "B V 3"],
    displacements: Float[Tensor, "V 3 C"],
    strengths: Float[Tensor, "B C"],
    normals: Float[Tensor, "V 3"],
    rises: Float[Tensor, "V K"],
    knuckles: Float[Tensor, "B K"],
    weights: Float[Tensor, "V J"],
    rotations: Float[Tensor, "B J 3 3"],
    shifts: Float[Tensor, "B J 3"],
) -> Float[Tensor, "B V 3"]:
    """Vertices of posed hands, float32: the bits of one hand are the same in any batch. Nothing carries a gradient.

    Args:
        rest: Each one's surface at rest [m].
        displacements: Of the pose correctives [m].
        strengths: How much of each.
        normals: Along which knuckles stand out.
        rises: How far, for a knuckle of strength 1 [m].
        knuckles: Strengths.
        weights: Of the bones.
        rotations: With `shifts` [m] they carry the rest points of each bone.
        shifts: See `rotations`.

    Raises:
        ValueError: wrong shapes.
    """
    sizes: dict[str, int] = {}
    check_shape("rest", rest, "B", "V", 3, sizes=sizes)
    check_shape("displacements", displacements, "V", 3, "C", sizes=sizes)
    check_shape("strengths", strengths, "B", "C", sizes=sizes)
    check_shape("normals", normals, "V", 3, sizes=sizes)
    check_shape("rises", rises, "V", "K", sizes=sizes)
    check_shape("knuckles", knuckles, "B", "K", sizes=sizes)
    check_shape("weights", weights, "V", "J", sizes=sizes)
    check_shape("rotations", rotations, "B", "J", 3, 3, sizes=sizes)
    check_shape("shifts", shifts, "B", "J", 3, sizes=sizes)
    return _op(rest, displacements, strengths, normals, rises, knuckles, weights, rotations, shifts)
