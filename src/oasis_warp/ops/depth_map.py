"""Depth, face id and barycentrics of the surface that a camera sees in each pixel."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from oasis_warp.ops._runtime.declaration import Array, Operator
from oasis_warp.ops._runtime.depth_buffer import draw, plane_size
from oasis_warp.ops._runtime.depth_scene import BufferParts, DepthScene
from oasis_warp.ops._runtime.incidence import incidence
from oasis_warp.ops.checks import check_choice, check_pixels, check_positive


class DepthMap(NamedTuple):
    """The nearest surface of each pixel, with a batch axis B if an argument has one.

    Fields that are not among `outputs` have no rows and no columns.
    """

    depth: Float[Tensor, "H W"] | Float[Tensor, "B H W"]
    """Depth along the camera's z axis [m], +inf where there is no surface."""
    face_ids: Int[Tensor, "H W"] | Int[Tensor, "B H W"]
    """Index of the face, -1 where there is none."""
    barycentrics: Float[Tensor, "H W 3"] | Float[Tensor, "B H W 3"]
    """Weights of that face's corners at the pixel's centre, perspective correct; 0 where there is none."""


MESH_AND_CAMERA = {
    "vertices": Array("?B V 3"),
    "faces": Array("F 3", index="V", hint="Three vertex indices a face."),
    "viewmat": Array("?B 4 4", hint="World to camera."),
    "K": Array("?B 3 3"),
}


def check_picture(width: int, height: int, near_plane: float) -> None:
    """Refuse sizes that cannot be drawn.

    Raises:
        ValueError: names the argument.
    """
    for name, size in (("width", width), ("height", height)):
        check_pixels(name, size)
    if plane_size(width, height) >= 2**31:
        raise ValueError(f"width: expected fewer than 2^31 pixels, got {width} x {height}. Draw the picture in tiles.")
    check_positive("near_plane", near_plane)


def expand_batch(tensor: Tensor, batch: int) -> Tensor:
    """`tensor`, of two axes without a batch axis, repeated over the batch without a copy."""
    if tensor.dim() > 2:
        return tensor
    return tensor[None] if batch == 1 else tensor.expand(batch, *tensor.shape)


def _depth_map(
    vertices: Tensor, faces: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, near_plane: float,
    depth: bool, face_ids: bool, barycentrics: bool, validate: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    table = incidence("faces", faces, vertices.shape[1], "vertices").table
    scene = DepthScene(vertices, table, viewmats, Ks, width, height, near_plane)
    buffer, _ = draw(scene, None, BufferParts(depth, face_ids, barycentrics), validate)
    return buffer.depth, buffer.face_ids, buffer.barycentrics


def _depth_map_fake(
    vertices, faces, viewmats, Ks, width, height, near_plane, depth, face_ids, barycentrics, validate
):  # fmt: skip
    scene = DepthScene(vertices, faces, viewmats, Ks, width, height, near_plane)
    return tuple(scene.empty_buffer(BufferParts(depth, face_ids, barycentrics)))


_OPERATOR = Operator(
    "depth_map",
    _depth_map,
    _depth_map_fake,
    inputs=MESH_AND_CAMERA,
    outputs={"depth": "?B H W", "face_ids": "?B H W", "barycentrics": "?B H W 3"},
    validates_itself=True,
    reference="visibility.depth_map",
)


@torch.no_grad()
def depth_map(
    vertices: Float[Tensor, "V 3"] | Float[Tensor, "B V 3"],
    faces: Int[Tensor, "F 3"],
    viewmat: Float[Tensor, "4 4"] | Float[Tensor, "B 4 4"],
    K: Float[Tensor, "3 3"] | Float[Tensor, "B 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    *,
    outputs: Sequence[Literal["depth", "face_ids", "barycentrics"]] = DepthMap._fields,
    validate: bool = True,
) -> DepthMap:
    """The nearest surface behind each pixel's centre, from either side. Not differentiable.

    Edges belong to both of their faces, so a closed surface has no holes; of faces at one depth the smallest index is
    kept. Faces may pass through the camera's plane (2D homogeneous rasterization, Olano and Greer 1997); a face that
    contains no pixel's centre is missed. Decided and interpolated in float64, so that distance costs no digits;
    deterministic, for any number of threads, and in a batch as alone.

    The map is a renderer of its own. The silhouette is `face_ids >= 0`; with `corners = values[faces[face_ids]]` of
    shape [H, W, 3, D], `(corners * barycentrics[..., None]).sum(-2)` interpolates any values of the vertices over the
    picture (colours, texture coordinates, normals), 0 over the background; `normals[face_ids]` shows values of faces.

    Args:
        vertices: Vertices of the mesh [m], shape [V, 3] or a batch [B, V, 3], float32 or float64.
        faces: Vertex indices, shape [F, 3], the same for all of the batch; F may be 0. Winding does not matter.
        viewmat: World to camera (x right, y down, z forward), shape [4, 4] or [B, 4, 4].
        K: Intrinsics [px], shape [3, 3] or [B, 3, 3]; pixel centres at .5. Skew is not used.
        width: Columns of the image.
        height: Rows of the image.
        near_plane: Depth up to which surfaces are not seen [m].
        outputs: Fields to compute. Barycentrics cost most, ids nearly nothing. Depths are float64 rounded to the
            vertices' type with barycentrics or on CUDA, else within 5e-6 in float32.
        validate: Check the values of the tensors too. Waits for a CUDA device: switch it off for inputs you trust.
            Shapes and indices are always checked, indices once for each tensor.

    Raises:
        ValueError: a wrong shape, dtype or index, a value that is not finite, or a size or focal length that is not
            positive.
    """
    sizes = _OPERATOR.check(vertices=vertices, faces=faces, viewmat=viewmat, K=K)
    check_picture(width, height, near_plane)
    if not isinstance(outputs, Sequence) or isinstance(outputs, str):
        raise TypeError(f"outputs: expected a list of names, got {type(outputs).__name__}.")
    for name in outputs:
        check_choice("outputs", name, DepthMap._fields)
    batch = sizes.get("B", 1)
    out = _OPERATOR(
        expand_batch(vertices, batch), faces, expand_batch(viewmat, batch), expand_batch(K, batch), width, height,
        near_plane, *(name in outputs for name in DepthMap._fields), validate,
    )  # fmt: skip
    return DepthMap(*(out if "B" in sizes else (t[0] for t in out)))
