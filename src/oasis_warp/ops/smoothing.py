"""Smoothing of values at vertices over the faces around them."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_kernels.scene import skin_light
from oasis_warp.ops._runtime.declaration import Array, Declaration
from oasis_warp.ops._runtime.incidence import incidence
from oasis_warp.ops._runtime.launch import launch_ranges

_SMOOTH = Declaration(
    "smooth_over_faces", inputs={"values": Array("B V C"), "faces": Array("F 3", index="V")}, public=False
)


@torch.no_grad()
def smooth_over_faces(values: Float[Tensor, "B V C"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "B V C"]:
    """Mean over the corners of the faces around each vertex, itself once per face; vertices without a face keep theirs.

    Float32, not differentiable.

    Raises:
        ValueError: a wrong shape or index.
    """
    sizes = _SMOOTH.check(values=values, faces=faces)
    index = incidence("faces", faces, sizes["V"], "vertices")
    out = torch.empty_like(values, memory_format=torch.contiguous_format)
    launch_ranges(skin_light.smooth, values.numel(), [values.contiguous(), *index, out], like=values)
    return out
