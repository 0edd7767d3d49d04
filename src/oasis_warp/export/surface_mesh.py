"""The avatar's surface as a mesh: texture coordinates, a cap on the wrist, skinning to WebXR's joints, .obj files."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.avatar.wrist import rim_axis
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.surface import vertex_normals
from oasis_warp.core.types import PosedHand
from oasis_warp.data.output_files import write_files
from oasis_warp.export import texture
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import photo_axes
from oasis_warp.hand.skinning import corrective_coefficients, correctives_per_joint
from oasis_warp.hand.webxr_rig import TO_WEBXR, Rig, webxr_rig
from oasis_warp.hand_avatar import Avatar

CAP_HEIGHT = 0.008
"""Height of the cap over the rim [m]: as much as pictures of a hand leave around it."""
CAP_CORNER = (0.0125, 0.9875)
"""Texture coordinates of the cap: a corner where the hand has no skin."""


class Topology(NamedTuple):
    """Vertices of the mesh, as vertices of the hand: U with a texture coordinate each, R of the rim, one of the cap."""

    vertex: Int[Tensor, "U+R"]
    """Vertex of the hand; the last vertex of the mesh is the mean of those of the rim."""
    rim: Int[Tensor, "R"]
    uv: Float[Tensor, "U+R+1 2"]
    """v points up in the picture."""
    faces: Int[Tensor, "F 3"]
    """Counter-clockwise seen from outside."""


def topology(avatar: Avatar) -> Topology:
    """How the mesh of this side of hand is connected."""
    hand = avatar.hand
    pairs, corner = torch.unique(
        torch.stack([hand.faces.flatten(), hand.uv_faces.flatten()], 1), dim=0, return_inverse=True
    )
    n_skin, n_rim = len(pairs), len(hand.rim)
    ring = n_skin + torch.arange(n_rim)
    cap = torch.stack([ring, ring.roll(-1), torch.full_like(ring, n_skin + n_rim)], 1)
    edge = hand.template[hand.rim]
    center, outwards = rim_cap_center(hand, hand.template)
    turning = torch.linalg.cross(edge.roll(-1, 0) - edge, center - edge).sum(0)
    if float(turning @ outwards) < 0:
        cap = cap.flip(1)
    faces = torch.cat([corner.unflatten(0, (-1, 3)), cap])
    corner_uv = torch.tensor(CAP_CORNER).expand(n_rim + 1, 2)
    return Topology(
        torch.cat([pairs[:, 0], hand.rim]), hand.rim, torch.cat([hand.uv[pairs[:, 1]], corner_uv]),
        faces.flip(1) if avatar.side == "left" else faces,
    )  # fmt: skip


def rim_cap_center(hand: HandModel, vertices: Float[Tensor, "V 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """The middle of the cap over the wrist [m], and the direction in which it points."""
    axis = rim_axis(vertices, hand.rim)
    return vertices[hand.rim].mean(0) + CAP_HEIGHT * axis, axis


def at_mesh(values: Float[Tensor, "V *D"], mesh: Topology) -> Float[Tensor, "W *D"]:
    """Values of the hand's vertices at those of the mesh."""
    return torch.cat([values[mesh.vertex], values[mesh.rim].mean(0, keepdim=True)])


def mesh_points(vertices: Float[Tensor, "V 3"], hand: HandModel, mesh: Topology) -> Float[Tensor, "W 3"]:
    """Vertices of the mesh where the hand's are `vertices` [m]."""
    points = at_mesh(vertices, mesh)
    points[-1] = rim_cap_center(hand, vertices)[0]
    return points


def mesh_normals(points: Float[Tensor, "W 3"], mesh: Topology) -> Float[Tensor, "W 3"]:
    """Unit normals, smooth across the seams of the texture and sharp at the edge of the cap."""
    n_skin = len(mesh.vertex) - len(mesh.rim)
    owner = torch.cat([mesh.vertex[:n_skin], int(mesh.vertex.max()) + 1 + torch.arange(len(mesh.rim) + 1)])
    welded = points.new_zeros(int(owner.max()) + 1, 3)
    welded[owner] = points
    return vertex_normals(welded, owner[mesh.faces])[owner]


INFLUENCES = 8
"""Joints that move a vertex, the stronger ones first; none of the bundled hand's vertices has more than 7."""
MIN_CORRECTIVE = 1e-9
"""Displacement [m] for which a corrective that moves nothing is taken."""


class SkinnedMesh(NamedTuple):
    """A mesh of W vertices in metres, the wrist at the origin, y up, fingers to -z; at rest."""

    hand: HandModel
    """Hand of the avatar's side, in its own axes."""
    rest: PosedHand
    rig: Rig
    mesh: Topology
    points: Float[Tensor, "W 3"]
    normals: Float[Tensor, "W 3"]
    joints: Int[Tensor, "W I"]
    """Joints of the rig."""
    weights: Float[Tensor, "W I"]
    correctives: Float[Tensor, "C W 3"]
    """Displacements before skinning, at weight 1 [m]."""
    corrective_names: tuple[str, ...]
    strengths: Float[Tensor, "C"]
    """Coefficients of `hand.skinning.corrective_coefficients` at weight 1."""

    def corrective_weights(self, angles: Float[Tensor, "*B 15 3"]) -> Float[Tensor, "*B C"]:
        """Weights of the correctives at joint `angles` [rad]; 0 to 1 within the limits of a hand with two a joint."""
        return corrective_coefficients(self.hand, angles.to(self.strengths)) / self.strengths


@torch.no_grad()
def skinned_mesh(avatar: Avatar) -> SkinnedMesh:
    """The mesh of an avatar."""
    hand, rest = avatar.parts[:2]
    rig, mesh = webxr_rig(hand, rest, avatar.side), topology(avatar)
    to_file = torch.tensor(TO_WEBXR[avatar.side]).to(rest.vertices)
    points = mesh_points(rest.vertices, hand, mesh) @ to_file.T
    joint_of_bone = torch.tensor([rig.bones.index(bone) for bone in range(len(hand.parents))])  # the first, no tip
    strongest = at_mesh(hand.weights, mesh).topk(INFLUENCES, dim=1)
    weights = strongest.values / strongest.values.sum(1, keepdim=True)
    correctives = at_mesh(hand.corrective_basis, mesh).permute(2, 0, 1) @ to_file.T
    whole = correctives_per_joint(hand) == 9
    parts = [f"turn{k}" for k in range(9)] if whole else ("bend", "bend squared")
    if whole:  # rotations may be negative; a metre at weight 1 suits bytes, see skinned_gltf
        strengths = 1 / correctives.abs().amax((1, 2)).clamp_min(MIN_CORRECTIVE)
    else:
        strengths = torch.stack([corrective_coefficients(hand, end) for end in hand.pose_limits[1:].unbind(-1)]).amax(0)
    return SkinnedMesh(
        hand, rest, rig, mesh, points, mesh_normals(points, mesh),
        joints=torch.where(weights > 0, joint_of_bone[strongest.indices], 0),
        weights=weights,
        correctives=correctives * strengths[:, None, None],
        corrective_names=tuple(f"{name} {part}" for name in hand.joint_names[1:] for part in parts),
        strengths=strengths,
    )  # fmt: skip


def write_obj(request: ExportRequest, path: Path) -> None:
    """NAME.obj, NAME.mtl and NAME_skin.png: upright as in the photo, y up, the wrist at the origin [m].

    All three appear when all are complete.

    Raises:
        InputError: a value is not finite, or a file cannot be written.
    """
    avatar, pose = request.avatar, request.pose or request.avatar.source_pose
    picture_path = path.with_name(f"{path.stem}_skin.png")
    posed, mesh, rotation = avatar.mesh(pose), topology(avatar), photo_axes(avatar.source_camera)
    points = (mesh_points(posed.vertices, avatar.hand, mesh) - posed.joints[0]) @ rotation.to(posed.joints).T
    corners = 1 + mesh.faces[:, :, None].expand(-1, -1, 3).flatten(1)  # the same row of v, vt and vn
    text = (
        f"mtllib {path.stem}.mtl\n{_rows('v', points)}{_rows('vt', mesh.uv)}{_rows('vn', mesh_normals(points, mesh))}"
        f"usemtl skin\n{_lines('f %d/%d/%d %d/%d/%d %d/%d/%d', corners.numpy())}"
    )
    material = f"newmtl skin\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nmap_Kd {picture_path.name}\n"
    picture = texture.encoded(texture.bake_texture(request, request.light or "none", texture.SIZE))
    write_files({path: text.encode(), path.with_suffix(".mtl"): material.encode(), picture_path: picture})


def _rows(name: str, values: torch.Tensor) -> str:
    numbers = values.detach().cpu().numpy()
    return _lines(name + " %.7f" * numbers.shape[1], numbers)


def _lines(pattern: str, values: np.ndarray) -> str:
    return (f"{pattern}\n" * len(values)) % tuple(values.ravel().tolist())
