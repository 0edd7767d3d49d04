"""Areas, normals and neighbourhoods of triangle meshes in torch."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize, pad

from oasis_warp.core.sums import add_at


def face_normals(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, "F 3"], Float[Tensor, "F"]]:
    """Unit normals (right-hand rule; zero for a degenerate face) and areas of faces."""
    cross = face_crosses(vertices, faces)
    double_area = cross.norm(dim=-1)
    return cross / double_area.clamp_min(1e-30)[:, None], double_area / 2


def scatter_to_vertices(
    values: Float[Tensor, "F D"], faces: Int[Tensor, "F 3"], n_vertices: int
) -> Float[Tensor, "V D"]:
    """Sum of the values of the faces around each vertex."""
    total = torch.zeros(n_vertices, values.shape[1], dtype=values.dtype, device=values.device)
    for corner in range(3):
        total = add_at(total, faces[:, corner], values)
    return total


def vertex_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Unit area-weighted vertex normals."""
    normals, areas = face_normals(vertices, faces)
    return normalize(scatter_to_vertices(normals * areas[:, None], faces, len(vertices)), dim=-1, eps=1e-30)


def open_vertices(faces: Int[Tensor, "F 3"], n_vertices: int) -> Bool[Tensor, "V"]:
    """Whether the faces around each vertex leave a gap; in a closed ring every neighbour is entered and left once."""
    come_less_gone = (faces.roll(-1, 1) - faces.roll(1, 1)).flatten().long()
    total = torch.zeros(n_vertices, dtype=torch.int64, device=faces.device)
    return total.index_add_(0, faces.flatten().long(), come_less_gone) != 0


def vertex_areas(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V"]:
    """A third of the area of the faces around each vertex."""
    _, areas = face_normals(vertices, faces)
    return scatter_to_vertices(areas[:, None] / 3, faces, len(vertices))[:, 0]


def mesh_edges(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "E 2"]:
    """Every edge once, lower vertex first, sorted."""
    pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).long()
    n = int(faces.max()) + 1 if len(faces) else 1
    keys = torch.unique(pairs.amin(1) * n + pairs.amax(1))  # of numbers, 20 times as fast as of pairs
    return torch.stack([keys // n, keys % n], 1).to(faces.dtype)


def smooth_over_mesh(
    values: Float[Tensor, "V D"], edges: Int[Tensor, "E 2"], passes: int
) -> Float[Tensor, "V D"]:
    """Mean of each vertex and its neighbours, `passes` times."""
    vertex, neighbour = torch.cat([edges, edges.flip(1)]).unbind(1)
    count = add_at(values.new_ones(len(values), 1), vertex, values.new_ones(len(vertex), 1))
    if values.is_cuda:  # a gather is as repeatable as `add_at` there, and many times as fast
        around = _members(vertex, neighbour, len(values), filler=len(values))
        for _ in range(passes):
            values = (values + gather_to_vertices(values, around)) / count
        return values
    for _ in range(passes):
        values = add_at(values, vertex, values[neighbour]) / count
    return values


def faces_of_vertices(faces: Int[Tensor, "F 3"], n_vertices: int) -> Int[Tensor, "V M"]:
    """The faces around each vertex, ascending; rows are filled up with F, one past the last face."""
    corners = torch.arange(faces.numel(), device=faces.device)
    return _members(faces.flatten(), corners // 3, n_vertices, filler=len(faces))


def _members(
    owner: Int[Tensor, "N"], member: Int[Tensor, "N"], n_owners: int, filler: int
) -> Int[Tensor, "O M"]:
    """The members of each owner in their order; rows are filled up."""
    order = owner.argsort(stable=True)
    owner, member = owner[order], member[order]
    count = torch.bincount(owner, minlength=n_owners)
    place = torch.arange(len(owner), device=owner.device) - (count.cumsum(0) - count)[owner]
    table = torch.full((n_owners, int(count.max())), filler, dtype=torch.int64, device=owner.device)
    table[owner, place] = member.long()
    return table


def gather_to_vertices(values: Float[Tensor, "*B F D"], members: Int[Tensor, "V M"]) -> Float[Tensor, "*B V D"]:
    """Sum of the values of what lies around each vertex, such as `faces_of_vertices`, as gathers of fixed order."""
    padded = pad(values, (0, 0, 0, 1))  # a zero row past the last one
    return padded[..., members, :].sum(-2)


def gathered_normals(
    vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"], vertex_faces: Int[Tensor, "V M"]
) -> Float[Tensor, "*B V 3"]:
    """Unit area-weighted vertex normals of many surfaces; `vertex_faces` are from `faces_of_vertices`."""
    return normalize(gather_to_vertices(face_crosses(vertices, faces), vertex_faces), dim=-1, eps=1e-30)


def face_crosses(vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "*B F 3"]:
    """Cross products of two edges of each face: its normal, as long as twice its area."""
    a, b, c = vertices[..., faces, :].unbind(-2)
    return torch.linalg.cross(b - a, c - a)
