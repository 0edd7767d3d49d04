"""Differentiable operators on torch tensors, computed by Warp kernels on the CPU or a CUDA device."""

from oasis_warp.ops.visibility import DepthMap as DepthMap
from oasis_warp.ops.visibility import DepthVisibility as DepthVisibility
from oasis_warp.ops.visibility import depth_map as depth_map
from oasis_warp.ops.visibility import depth_visibility as depth_visibility
