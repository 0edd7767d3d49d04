"""Differentiable operators on torch tensors, computed by Warp kernels on the CPU or a CUDA device."""

from oasis_warp.ops._pair_counts import watch_overflow as watch_overflow
from oasis_warp.ops._values import Look as Look
from oasis_warp.ops._values import check_finite as check_finite
from oasis_warp.ops.blend_weights import BlendWeights as BlendWeights
from oasis_warp.ops.blend_weights import blend_colors as blend_colors
from oasis_warp.ops.blend_weights import blend_weights as blend_weights
from oasis_warp.ops.bone_transforms import BoneTransforms as BoneTransforms
from oasis_warp.ops.bone_transforms import bone_transforms as bone_transforms
from oasis_warp.ops.depth_map import DepthMap as DepthMap
from oasis_warp.ops.depth_map import depth_map as depth_map
from oasis_warp.ops.face_rotations import FaceRotations as FaceRotations
from oasis_warp.ops.face_rotations import face_rotations as face_rotations
from oasis_warp.ops.mesh_posing import PosedOnMesh as PosedOnMesh
from oasis_warp.ops.mesh_posing import pose_on_mesh as pose_on_mesh
from oasis_warp.ops.mesh_posing_covars import PosedCovars as PosedCovars
from oasis_warp.ops.mesh_posing_covars import pose_on_mesh_covars as pose_on_mesh_covars
from oasis_warp.ops.rasterization import rasterization as rasterization
from oasis_warp.ops.rest_mesh import RestMesh as RestMesh
from oasis_warp.ops.rest_mesh import rest_mesh as rest_mesh
from oasis_warp.ops.skinning import Skinned as Skinned
from oasis_warp.ops.skinning import skin as skin
from oasis_warp.ops.spherical_harmonics import spherical_harmonics as spherical_harmonics
from oasis_warp.ops.visibility import DepthVisibility as DepthVisibility
from oasis_warp.ops.visibility import depth_visibility as depth_visibility
from oasis_warp.ops.warm_up import warm_up as warm_up
