"""The plans of float32 posing on CUDA: a surface from joint angles, and Gaussians bound to its mesh.

One pose a call, with the kernels of the operators apart: `bone_transforms` and `skin` for the surface, `face_rotations`
and `pose_on_mesh` for the Gaussians. What passes between two kernels lies in one workspace.
"""

import weakref
from typing import Any, NamedTuple

import torch
from torch import Tensor

from oasis_kernels.posing import face_rotation_native as rotations
from oasis_kernels.posing import mesh_gaussians
from oasis_kernels.runtime.cuda_native import CudaNative
from oasis_kernels.skinning import kinematics
from oasis_kernels.skinning import skinning_native as skinning
from oasis_warp.ops._runtime.incidence import Incidence
from oasis_warp.ops._runtime.launch import aligned, block_count, cuda_launch, current_stream
from oasis_warp.ops._runtime.mesh_gaussians import MeshGaussians, find_gaussians
from oasis_warp.ops._runtime.plans import CudaLaunch, addresses, lay_out

ORDERS = {
    "bone_transforms": "n_joints angles joints axes parents orientation translation locals transforms bends",
    "skin": "n n_joints n_correctives means covars weights transforms displacements strengths n_poses out_means "
    "out_covars",
    "skin_backward": "n n_joints n_correctives means covars weights transforms displacements strengths g_out_means "
    "g_out_covars g_means g_covars g_weights sums",
    "sum_blocks": "n_joints n_sums sums g_transforms",
    "bone_transforms_backward": "n_joints angles joints axes parents transforms locals g_transforms g_bends sums "
    "g_angles g_orientation g_translation g_joints",
    "rotate_faces": "n_vertices n_faces rest_vertices faces triangles posed_vertices face_quats area_ratio "
    "rows_of_faces flat_blocks",
    "rotate_vertices": "n_vertices n_faces offsets corners rows_of_faces flat_blocks face_quats vertex_quats "
    "vertex_area_ratio signs sums",
    "pose_mesh_gaussians": "n_vertices n_faces n_on_vertices n_on_faces half_powers vertices faces vertex_index "
    "face_index barycentrics vertex_quats area_ratio vertex_area_ratio offsets quats scales means posed_quats "
    "posed_scales",
    "pose_mesh_gaussians_backward": "n_vertices n_faces n_on_vertices n_on_faces half_powers vertices faces "
    "vertex_index face_index barycentrics vertex_quats area_ratio vertex_area_ratio offsets quats scales g_means "
    "g_posed_quats g_posed_scales gaussian_rows weights by_ratio g_barycentrics g_quats g_scales g_offsets",
    "gather_mesh_gaussians": "n_vertices n_faces n_on_vertices n_on_faces barycentrics gaussian_rows weights by_ratio "
    "vertex_starts places face_starts face_gaussians g_vertices g_vertex_quats g_vertex_area_ratio g_area_ratio",
    "rotate_faces_backward": "n_vertices n_faces rest_vertices faces triangles posed_vertices vertex_quats face_quats "
    "vertex_area_ratio signs sums g_vertex_quats g_face_quats g_area_ratio g_vertex_area_ratio rest_edges posed_edges",
    "gather_edges": "n_vertices n_faces offsets corners rest_edges posed_edges g_rest g_posed",
}
"""Parameters of the kernels in the order in which they are given here."""
HALF_POWERS = 1
"""Scales go with the root of the area."""


class SkinningInputs(NamedTuple):
    """Float tensors of a pose of a surface."""

    angles: Tensor
    orientation: Tensor
    translation: Tensor
    joints: Tensor
    rest_vertices: Tensor
    axes: Tensor
    """This and the next receive no gradient."""
    weights: Tensor
    displacements: Tensor | None


class GaussianInputs(NamedTuple):
    """Float tensors of Gaussians on a posed mesh."""

    rest_vertices: Tensor
    posed_vertices: Tensor
    barycentrics: Tensor
    offsets: Tensor | None
    quats: Tensor
    scales: Tensor
    triangles: Tensor | None
    """Triangles of the rest mesh; they receive no gradient."""


class MeshBinding(NamedTuple):
    """What binds Gaussians to a mesh."""

    faces: Tensor
    face_index: Tensor
    vertex_index: Tensor | None


class _Plan:
    """The device and stream that calls of one kind run on."""

    def __init__(self, like: Tensor) -> None:
        self.device, self._index = like.device, like.get_device()
        self._warp_device = current_stream(like.device).device

    def _launch(self, native: CudaNative) -> CudaLaunch:
        """This thread's launch of a kernel, whose parameters come in the order of `ORDERS`."""
        return cuda_launch(native, self._warp_device)

    def _stream(self) -> int:
        return torch._C._cuda_getCurrentRawStream(self._index)

    def _empty(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=self.device)


class SkinningPlan(_Plan):
    """Bones, then skin with two pose correctives a joint or none."""

    def __init__(self, given: SkinningInputs, parents: Tensor) -> None:
        super().__init__(given.angles)
        self._parents = parents
        self._n, self._n_joints = n, n_joints = given.weights.shape
        self._n_correctives = 0 if given.displacements is None else given.displacements.shape[-1]
        self._at, self._size = lay_out({
            "locals": 8 * kinematics.LOCAL * n_joints, "transforms": 4 * 12 * n_joints, "bends": 8 * (n_joints - 1)
        })  # fmt: skip
        self._bones = self._launch(kinematics.on_cuda("bone_transforms", "float"))
        self._skin = self._launch(skinning.cuda_skin)
        self._skin_blocks = block_count(n, skinning.POINTS)
        self._sum_blocks = block_count(n, skinning.BLOCK)

    def pose(self, given: SkinningInputs) -> tuple[Tensor, Tensor]:
        """Posed vertices, and the workspace."""
        stream = self._stream()
        angles, orientation, translation, joints, means, axes, weights, displacements = addresses(given)
        workspace, posed = self._empty(self._size, dtype=torch.uint8), self._empty(self._n, 3)
        base = workspace.data_ptr()
        locals, transforms, bends = (base + at for at in self._at.values())
        self._bones(
            1, stream, self._n_joints, angles, joints, axes, self._parents.data_ptr(), orientation, translation, locals,
            transforms, bends,
        )  # fmt: skip
        self._skin(
            self._skin_blocks, stream, self._n, self._n_joints, self._n_correctives, means, 0, weights, transforms,
            displacements, bends if displacements else 0, 1, posed.data_ptr(), 0,
        )  # fmt: skip
        return posed, workspace

    def backward(self, given: SkinningInputs, workspace: Tensor, gradient: Tensor, needs: Any) -> list[Tensor | None]:
        """Gradients by angles, orientation, translation, joints and vertices at rest, where they are wanted."""
        stream, n, n_joints = self._stream(), self._n, self._n_joints
        angles, _, _, joints, means, axes, weights, displacements = addresses(given)
        base = workspace.data_ptr()
        locals, transforms, bends = (base + at for at in self._at.values())
        by_bones = any(needs[:4])
        has_correctives = given.displacements is not None
        by_points = self._empty(n, 3) if needs[4] or (has_correctives and by_bones) else None
        sums = self._empty(self._sum_blocks, 12 * n_joints) if by_bones else None
        self._launch(skinning.cuda_skin_backward)(
            self._sum_blocks, stream, n, n_joints, self._n_correctives, means, 0, weights, transforms, displacements,
            bends if displacements else 0, gradient.data_ptr(), 0, *addresses((by_points,)), 0, 0, *addresses((sums,)),
        )  # fmt: skip
        out: list[Tensor | None] = [None, None, None, None, by_points if needs[4] else None]
        if sums is None:
            return out
        by_bends = None
        if by_points is not None and given.displacements is not None:
            by_bends = by_points.flatten() @ given.displacements.flatten(0, 1)
        passed = self._empty(36 * n_joints)  # by transforms; then float64 scratch as large as `locals`
        self._launch(skinning.cuda_sum_blocks)(
            block_count(12 * n_joints, skinning.BLOCK), stream, n_joints, self._sum_blocks, sums.data_ptr(),
            passed.data_ptr() + 96 * n_joints,
        )  # fmt: skip
        for k, tensor in enumerate(given[:4]):
            if needs[k]:
                out[k] = torch.empty(tensor.shape, dtype=torch.float32, device=self.device)
        self._launch(kinematics.on_cuda("bone_transforms_backward", "float"))(
            1, stream, n_joints, angles, joints, axes, self._parents.data_ptr(), transforms, locals,
            passed.data_ptr() + 96 * n_joints, *addresses((by_bends,)), passed.data_ptr(), *addresses(out[:4]),
        )  # fmt: skip
        return out


class GaussiansPlan(_Plan):
    """Rotations of faces and vertices, then the Gaussians on them."""

    def __init__(self, given: GaussianInputs, binding: MeshBinding) -> None:
        super().__init__(given.quats)
        self._n_vertices, self._n_faces = v, f = len(given.posed_vertices), len(binding.faces)
        self._q, self._n = len(binding.face_index), len(given.quats)
        self._p = self._n - self._q
        self._sizes = v, f, self._p, self._q
        self._face_blocks, self._vertex_blocks = block_count(f, rotations.BLOCK), block_count(v, rotations.BLOCK)
        self._gaussian_blocks = block_count(self._p, mesh_gaussians.BLOCK) + block_count(self._q, mesh_gaussians.BLOCK)
        self._at, self._size = lay_out({
            "rows_of_faces": 32 * f, "flat_blocks": 4 * self._face_blocks, "face_quats": 16 * f, "vertex_quats": 16 * v,
            "area_ratio": 4 * f, "vertex_area_ratio": 4 * v,
        })  # fmt: skip
        places, self._size_with_saved = lay_out({"signs": 12 * f, "sums": 8 * v}, self._size)
        self._at |= places
        self._passed_at, self._passed_size = lay_out({
            "gaussian_rows": 32 * self._n, "weights": 12 * self._q, "by_ratio": 4 * self._q, "area_ratio": 4 * f,
            "vertex_area_ratio": 4 * v, "rest_edges": 32 * f, "posed_edges": 32 * f,
        })  # fmt: skip
        self._rotate_faces = self._launch(rotations.rotate_faces)
        self._rotate_vertices = self._launch(rotations.rotate_vertices)
        self._pose_gaussians = self._launch(mesh_gaussians.pose_mesh_gaussians)
        self._known: tuple[Any, ...] = ()

    def _bound(self, binding: MeshBinding) -> tuple[Incidence, tuple[int, ...], MeshGaussians]:
        """The binding's incidence tables, and the addresses of faces and of the Gaussians on each vertex and face."""
        state = [None if t is None else (t._version, t.data_ptr()) for t in binding]
        if self._known and self._known[0] == state and _alive(self._known[1], binding):
            return self._known[2]
        faces, face_index, vertex_index = binding
        bound = find_gaussians(faces, face_index, vertex_index, self._n_vertices, transposed=False)
        on_vertices = None if bound.on_vertices is None else bound.on_vertices.table
        found = bound.corners, tuple(addresses((bound.corners.table, on_vertices, bound.on_faces.table))), bound
        if not any(t is not None and t.is_inference() for t in binding):  # whose versions are not counted
            self._known = state, [t if t is None else weakref.ref(t) for t in binding], found
        return found

    def pose(self, given: GaussianInputs, binding: MeshBinding, keep: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means, quaternions, scales, and the workspace, which holds what the adjoint needs with `keep`."""
        stream, at = self._stream(), self._at
        corners, (faces, on_vertices, on_faces), _ = self._bound(binding)
        rest, posed, barycentrics, offsets, quats, scales, triangles = addresses(given)
        workspace = self._empty(self._size_with_saved if keep else self._size, dtype=torch.uint8)
        out = self._empty(self._n, 3), self._empty(self._n, 4), self._empty(self._n, 3)
        base = workspace.data_ptr()
        rows, flat, face_quats = base + at["rows_of_faces"], base + at["flat_blocks"], base + at["face_quats"]
        vertex_quats, vertex_ratios = base + at["vertex_quats"], base + at["vertex_area_ratio"]
        of_faces = base + at["area_ratio"]
        self._rotate_faces(
            self._face_blocks, stream, self._n_vertices, self._n_faces, rest, faces, triangles, posed, face_quats,
            of_faces, rows, flat,
        )  # fmt: skip
        self._rotate_vertices(
            self._vertex_blocks, stream, self._n_vertices, self._n_faces, corners.offsets.data_ptr(),
            corners.entries.data_ptr(), rows, flat, face_quats, vertex_quats, vertex_ratios,
            *((base + at["signs"], base + at["sums"]) if keep else (0, 0)),
        )  # fmt: skip
        self._pose_gaussians(
            self._gaussian_blocks, stream, *self._sizes, HALF_POWERS, posed, faces, on_vertices, on_faces, barycentrics,
            vertex_quats, of_faces, vertex_ratios, offsets, quats, scales, *addresses(out),
        )  # fmt: skip
        return *out, workspace

    def vertex_quats(self, workspace: Tensor) -> Tensor:
        """A copy of the rotations of vertices, [V, 4]."""
        start = self._at["vertex_quats"]
        return workspace[start : start + 16 * self._n_vertices].view(torch.float32).view(-1, 4).clone()

    def backward(
        self, given: GaussianInputs, binding: MeshBinding, workspace: Tensor, incoming: Any, needs: Any
    ) -> list[Tensor | None]:
        """Gradients in the order of `GaussianInputs`; `incoming` are those by means, quats, scales and vertex quats."""
        *by_gaussians, g_quats_out = aligned(*incoming)
        out: list[Tensor | None] = [
            self._empty(*tensor.shape) if tensor is not None and needed else None
            for tensor, needed in zip(given, needs, strict=True)
        ]
        stream = self._stream()
        surface = needs[0] or needs[1]
        passed = self._empty(self._passed_size, dtype=torch.uint8) if surface else None
        by_vertices = g_vertex_quats = None
        has_gaussians = any(g is not None for g in by_gaussians)
        if has_gaussians:
            by_vertices = self._empty(self._n_vertices, 3) if needs[1] else None
            g_vertex_quats = self._empty(self._n_vertices, 4) if surface else None
            self._gaussians_backward(
                given, binding, workspace, (by_gaussians, out[2:6]), passed, (by_vertices, g_vertex_quats), stream
            )
        if passed is None:
            return out if has_gaussians else [None] * len(out)
        if g_quats_out is not None:
            g_vertex_quats = g_quats_out if g_vertex_quats is None else g_vertex_quats.add_(g_quats_out)
        self._rotations_backward(given, binding, workspace, g_vertex_quats, passed, has_gaussians, out, stream)
        if by_vertices is not None and out[1] is not None:
            out[1].add_(by_vertices)
        return out if has_gaussians else [*out[:2], *[None] * (len(out) - 2)]

    def _gaussians_backward(
        self, given: GaussianInputs, binding: MeshBinding, workspace: Tensor, gradients: tuple[Any, Any],
        passed: Tensor | None, of_vertices: tuple[Tensor | None, Tensor | None], stream: int,
    ) -> None:  # fmt: skip
        """The adjoint of the Gaussians: from `gradients[0]` to `gradients[1]`, `passed` and those `of_vertices`."""
        at, base, there = self._at, workspace.data_ptr(), self._passed_at
        _, (faces, on_vertices, on_faces), bound = self._bound(binding)
        _, posed, barycentrics, offsets, quats, scales, _ = addresses(given)
        incoming, (g_barycentrics, g_offsets, g_quats, g_scales) = gradients
        to = 0 if passed is None else passed.data_ptr()
        rows, weights, by_ratio = ((to and to + there[name]) for name in ("gaussian_rows", "weights", "by_ratio"))
        self._launch(mesh_gaussians.pose_mesh_gaussians_backward)(
            self._gaussian_blocks, stream, *self._sizes, HALF_POWERS, posed, faces, on_vertices, on_faces, barycentrics,
            base + at["vertex_quats"], base + at["area_ratio"], base + at["vertex_area_ratio"], offsets, quats, scales,
            *addresses(incoming), rows, weights, by_ratio,
            *addresses((g_barycentrics, g_quats, g_scales, g_offsets)),
        )  # fmt: skip
        if passed is None:
            return
        at_vertices = find_gaussians(*binding, self._n_vertices, transposed=True).at_vertices
        assert at_vertices is not None
        self._launch(mesh_gaussians.gather_mesh_gaussians)(
            block_count(self._n_vertices, mesh_gaussians.BLOCK) + block_count(self._n_faces, mesh_gaussians.BLOCK),
            stream, *self._sizes, barycentrics, rows, weights, by_ratio, at_vertices.offsets.data_ptr(),
            at_vertices.entries.data_ptr(), bound.on_faces.offsets.data_ptr(), bound.on_faces.entries.data_ptr(),
            *addresses(of_vertices), to + there["vertex_area_ratio"] if self._p else 0, to + there["area_ratio"],
        )  # fmt: skip

    def _rotations_backward(
        self, given: GaussianInputs, binding: MeshBinding, workspace: Tensor, g_vertex_quats: Tensor | None,
        passed: Tensor, has_gaussians: bool, out: list[Tensor | None], stream: int,
    ) -> None:  # fmt: skip
        """The adjoint of the rotations, into the first two of `out`."""
        at, base, there, to = self._at, workspace.data_ptr(), self._passed_at, passed.data_ptr()
        corners, (faces, _, _), _ = self._bound(binding)
        rest, posed, *_, triangles = addresses(given)
        edges = [to + there[name] if g is not None else 0
                 for name, g in zip(("rest_edges", "posed_edges"), out, strict=False)]  # fmt: skip
        saved = [base + at[name] for name in ("vertex_quats", "face_quats", "vertex_area_ratio", "signs", "sums")]
        ratios = (
            (to + there["area_ratio"], to + there["vertex_area_ratio"] if self._p else 0) if has_gaussians else (0, 0)
        )
        self._launch(rotations.rotate_faces_backward)(
            self._face_blocks, stream, self._n_vertices, self._n_faces, rest, faces, triangles, posed, *saved,
            *addresses((g_vertex_quats,)), 0, *ratios, *edges,
        )  # fmt: skip
        self._launch(rotations.gather_edges)(
            self._vertex_blocks, stream, self._n_vertices, self._n_faces, corners.offsets.data_ptr(),
            corners.entries.data_ptr(), *edges, *addresses(out[:2]),
        )  # fmt: skip


def _alive(references: Any, binding: MeshBinding) -> bool:
    return all(r is t if r is None else r() is t for r, t in zip(references, binding, strict=True))
