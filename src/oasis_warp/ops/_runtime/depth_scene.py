"""What is drawn into depth buffers, and what comes out: the nouns of all ways to draw.

Everything has a leading batch axis here. A tensor that is the same for the whole batch may come expanded.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class Scene(NamedTuple):
    """Meshes and cameras. B batch entries, V vertices, F faces."""

    vertices: Tensor
    """[B, V, 3]."""
    faces: Tensor
    """int32 [F, 3], contiguous, every index in [0, V)."""
    viewmats: Tensor
    """[B, 4, 4]."""
    Ks: Tensor
    """[B, 3, 3]."""
    width: int
    height: int
    near_plane: float

    def room(self, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        """An empty tensor of `shape` for each batch entry, of the vertices' type unless told."""
        return self.vertices.new_empty((self.vertices.shape[0], *shape), dtype=dtype)


class Query(NamedTuple):
    """Points to be scored."""

    points: Tensor
    """[B, P, 3]."""
    point_vertices: Tensor | None
    """int32 or int64 [P], contiguous: the vertex that each point is, or -1."""
    by_identity: bool
    """Whether points that are vertices of a face in view are seen by that alone."""
    tau: float
    margin: float
    keep: bool
    """Whether `Scores.slopes` and `pixels` are wanted."""


class Wanted(NamedTuple):
    """Which parts of a `Buffer` somebody needs."""

    depth: bool = True
    face_ids: bool = True
    barycentrics: bool = True


class Buffer(NamedTuple):
    """What the cameras see. A part that was not wanted has no rows and no columns."""

    depth: Tensor
    """[B, H, W]."""
    face_ids: Tensor
    """int32 [B, H, W]."""
    barycentrics: Tensor
    """[B, H, W, 3]."""


def empty_buffer(scene: Scene, wanted: Wanted) -> Buffer:
    """Room for the parts that are wanted."""
    size, nothing = (scene.height, scene.width), (0, 0)
    return Buffer(
        scene.room(*(size if wanted.depth else nothing)),
        scene.room(*(size if wanted.face_ids else nothing), dtype=torch.int32),
        scene.room(*(size if wanted.barycentrics else nothing), 3),
    )


class Scores(NamedTuple):
    """Visibility of the points of a `Query`, and what its adjoint needs."""

    visibility: Tensor
    """[B, P]."""
    slopes: Tensor
    """Derivative with respect to the point's depth, [B, P]; [B, 0] unless kept."""
    pixels: Tensor
    """int32: row * width + column where the score is soft, else -1; as `slopes`."""


def empty_scores(scene: Scene, query: Query) -> Scores:
    """Room for what is asked of the points."""
    n_points = query.points.shape[1]
    kept = n_points if query.keep else 0
    return Scores(scene.room(n_points), scene.room(kept), scene.room(kept, dtype=torch.int32))


def shared(tensor: Tensor) -> tuple[Tensor, int]:
    """A tensor of contiguous batch entries, and the step from one to the next: 0 where they are the same."""
    if tensor.stride(0) == 0 and len(tensor) > 1:
        return tensor[0].contiguous(), 0
    tensor = tensor.contiguous()
    return tensor, tensor.stride(0)


def only(buffer: Buffer, wanted: Wanted) -> Buffer:
    """`buffer` without what nobody wanted but had to be drawn all the same."""
    parts = (
        part if is_wanted else part.new_empty((len(part), 0, 0, *part.shape[3:]))
        for part, is_wanted in zip(buffer, wanted, strict=True)
    )
    return Buffer(*parts)
