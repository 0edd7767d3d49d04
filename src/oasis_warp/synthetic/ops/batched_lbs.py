"""Linear blend skinning of a batch of hands of different people, with correctives on each resting surface."""

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from oasis_kernels.skinning import batched_lbs as kernels
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.launch import launch_ranges, view
from oasis_warp.synthetic.ops.views import scalars, vectors

_DECLARATION = Declaration(
    "batched_lbs",
    inputs={
        "rest": Array("B V 3"),
        "displacements": Array("V 3 C"),
        "strengths": Array("B C"),
        "normals": Array("V 3"),
        "rises": Array("V K"),
        "knuckles": Array("B K"),
        "weights": Array("V J"),
        "rotations": Array("B J 3 3"),
        "shifts": Array("B J 3"),
    },
    public=False,
)


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
    """Vertices of posed hands, float32: the bits of one hand are the same in any batch. Not differentiable.

    Args:
        rest: Surface of each hand at rest [m].
        displacements: Displacements of the pose correctives [m].
        strengths: Strengths of the pose correctives.
        normals: Directions in which knuckles stand out.
        rises: Heights for a knuckle of strength 1 [m].
        knuckles: Strengths of the knuckles.
        weights: Skinning weights of the bones.
        rotations: Rotation of each bone, applied to rest points before `shifts`.
        shifts: Translation of each bone [m].

    Raises:
        ValueError: wrong shapes.
    """
    _DECLARATION.check(
        rest=rest, displacements=displacements, strengths=strengths, normals=normals, rises=rises, knuckles=knuckles,
        weights=weights, rotations=rotations, shifts=shifts,
    )  # fmt: skip
    out = torch.empty_like(rest, memory_format=torch.contiguous_format)
    inputs = [
        vectors(rest), scalars(displacements), scalars(strengths), vectors(normals), scalars(rises), scalars(knuckles),
        scalars(weights), view(rotations.contiguous(), wp.mat33f), vectors(shifts), vectors(out),
    ]  # fmt: skip
    launch_ranges(kernels.batched_lbs, rest.shape[0] * rest.shape[1], inputs, like=rest)
    return out
