"""Inputs and outputs of the depth buffer, shared by all backends.

All tensors have a leading batch axis. One that is the same for the whole batch may be expanded.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class DepthScene(NamedTuple):
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

    def empty(self, *shape: int | torch.SymInt, dtype: torch.dtype | None = None) -> Tensor:
        """An empty tensor of `shape` for each batch entry, by default of the vertices' type."""
        return self.vertices.new_empty((self.vertices.shape[0], *shape), dtype=dtype)

    def empty_buffer(self, parts: "BufferParts") -> "Buffer":
        """Memory for the parts to fill."""
        size, nothing = (self.height, self.width), (0, 0)
        return Buffer(
            self.empty(*(size if parts.depth else nothing)),
            self.empty(*(size if parts.face_ids else nothing), dtype=torch.int32),
            self.empty(*(size if parts.barycentrics else nothing), 3),
        )

    def empty_scores(self, query: "Query") -> "Scores":
        """Memory for the scores of the points."""
        n_points = query.points.shape[1]
        kept = n_points if query.keep else 0
        return Scores(self.empty(n_points), self.empty(kept), self.empty(kept, dtype=torch.int32))


class Query(NamedTuple):
    """Points to score."""

    points: Tensor
    """[B, P, 3]."""
    point_vertices: Tensor | None
    """int32 [P], contiguous, every index in [-1, V): the vertex that each point is, or -1."""
    by_identity: bool
    """Whether points that are vertices of a face in view count as seen."""
    tau: float
    margin: float
    keep: bool
    """Whether to fill `Scores.slopes` and `pixels`."""


class BufferParts(NamedTuple):
    """The parts of a `Buffer` to fill."""

    depth: bool = True
    face_ids: bool = True
    barycentrics: bool = True


class Buffer(NamedTuple):
    """What the cameras see. A part that is not filled has no rows and no columns."""

    depth: Tensor
    """[B, H, W]."""
    face_ids: Tensor
    """int32 [B, H, W]."""
    barycentrics: Tensor
    """[B, H, W, 3]."""


class Scores(NamedTuple):
    """Visibility of the points of a `Query`, and what its adjoint needs."""

    visibility: Tensor
    """[B, P]."""
    slopes: Tensor
    """Derivative with respect to the point's depth, [B, P]; [B, 0] unless `keep`."""
    pixels: Tensor
    """int32: row * width + column where the score is soft, else -1; as `slopes`."""


def shared(tensor: Tensor) -> tuple[Tensor, int]:
    """A tensor of contiguous batch entries, and the step from one to the next: 0 where they are the same."""
    if tensor.stride(0) == 0 and len(tensor) > 1:
        return tensor[0].contiguous(), 0
    tensor = tensor.contiguous()
    return tensor, tensor.stride(0)


def restrict(buffer: Buffer, outputs: BufferParts) -> Buffer:
    """`buffer` without the parts that were drawn only because others need them."""
    parts = (
        part if needed else part.new_empty((len(part), 0, 0, *part.shape[3:]))
        for part, needed in zip(buffer, outputs, strict=True)
    )
    return Buffer(*parts)
