"""Chains of the posing operators as a hand needs them: on CUDA two nodes of autograd instead of four."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.ops._runtime import posing_node
from oasis_warp.ops._runtime.posing_plan import GaussianInputs, MeshBinding, SkinningInputs
from oasis_warp.ops.bone_transforms import bone_transforms, parents_on
from oasis_warp.ops.face_rotations import RestMesh, face_rotations
from oasis_warp.ops.mesh_posing import pose_on_mesh
from oasis_warp.ops.skinning import skin


class PosedGaussians(NamedTuple):
    """Posed Gaussians, those on vertices first, and the rotations of the vertices."""

    means: Float[Tensor, "*B N 3"]
    quats: Float[Tensor, "*B N 4"]
    scales: Float[Tensor, "*B N 3"]
    vertex_quats: Float[Tensor, "*B V 4"] | None
    """None unless it was asked for."""


def skinned_vertices(
    angles: Float[Tensor, "*B A 3"],
    orientation: Float[Tensor, "*B 3 3"],
    translation: Float[Tensor, "*B 3"],
    joints: Float[Tensor, "J 3"],
    axes: Float[Tensor, "J 3 3"],
    parents: Sequence[int],
    rest_vertices: Float[Tensor, "V 3"],
    weights: Float[Tensor, "V J"],
    displacements: Float[Tensor, "V 3 C"] | None,
) -> Float[Tensor, "*B V 3"]:
    """`skin` of vertices by `bone_transforms`, whose bends are the strengths of the `displacements`.

    Arguments and errors are those of the two operators; values are not checked.
    """
    if all(isinstance(part, Tensor) for part in (angles, orientation, translation)):
        angles, orientation, translation = (part.contiguous() for part in (angles, orientation, translation))
    given = SkinningInputs(angles, orientation, translation, joints, rest_vertices, axes, weights, displacements)
    kind = posing_node.kind_of(given, tuple(parents))
    constant = axes, weights, displacements
    if kind is not None and torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in constant):
        kind = None
    plan = posing_node.plan_of(kind)
    if plan is not None:
        return posing_node.skin_surface(plan, given)
    bones = bone_transforms(angles, orientation, translation, joints, axes, parents, validate=False)
    strengths = None if displacements is None else bones.bends
    posed = skin(
        rest_vertices, None, weights, bones.transforms, displacements=displacements, strengths=strengths, validate=False
    ).means
    if kind is not None:
        posing_node.remember_skinning(kind, given, parents_on(angles.device, tuple(parents)))
    return posed


def pose_mesh_gaussians(
    rest_vertices: Float[Tensor, "V 3"] | RestMesh,
    posed_vertices: Float[Tensor, "*B V 3"],
    faces: Int[Tensor, "F 3"],
    face_index: Int[Tensor, "Q"],
    barycentrics: Float[Tensor, "Q 3"],
    vertex_index: Int[Tensor, "P"] | None,
    offsets: Float[Tensor, "P 3"] | None,
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    with_vertex_quats: bool = False,
) -> PosedGaussians:
    """`pose_on_mesh` by `face_rotations`, by the root of areas; with `with_vertex_quats` the rotations of vertices too.

    Arguments and errors are those of the two operators; values are not checked.
    """
    rest, triangles = rest_vertices if isinstance(rest_vertices, RestMesh) else (rest_vertices, None)
    given = GaussianInputs(rest, posed_vertices, barycentrics, offsets, quats, scales, triangles)
    binding = MeshBinding(faces, face_index, vertex_index)
    kind = posing_node.kind_of(given, tuple(None if t is None else (t.shape, t.device) for t in binding))
    plan = posing_node.plan_of(kind)
    if plan is not None:
        return PosedGaussians(*posing_node.pose_mesh_gaussians(plan, given, binding, with_vertex_quats))
    rotations = face_rotations(rest_vertices, posed_vertices, faces, validate=False)
    posed = pose_on_mesh(
        posed_vertices, faces, face_index, barycentrics, rotations.vertex_quats, rotations.area_ratio, quats, scales,
        vertex_index=vertex_index, offsets=offsets,
        vertex_area_ratio=None if vertex_index is None else rotations.vertex_area_ratio, validate=False,
    )  # fmt: skip
    if kind is not None:
        posing_node.remember_mesh_gaussians(kind, given, binding)
    return PosedGaussians(*posed, rotations.vertex_quats if with_vertex_quats else None)
