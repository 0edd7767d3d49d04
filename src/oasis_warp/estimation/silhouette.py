"""The filled outline of a projected mesh as a mask of bytes, drawn by OpenCV: the fit's own picture of the hand."""

import cv2
import numpy as np

_SUBPIXEL_BITS = 4


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of the vertices, weighted by the areas of their faces, [V, 3]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    corner = faces.T.ravel()
    total = np.stack([np.bincount(corner, np.tile(normal[:, i], 3), len(vertices)) for i in range(3)], 1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def facing(image: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces whose corners turn as those seen from outside do (image y points down)."""
    a, b, c = (image[faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    return faces[u[:, 0] * v[:, 1] < u[:, 1] * v[:, 0]]


def silhouette(image: np.ndarray, faces: np.ndarray, size: tuple[int, int], low: np.ndarray | None = None,
               scale: float = 1.0) -> np.ndarray:  # fmt: skip
    """255 where the mesh covers a pixel's centre, 0 elsewhere, [height, width] bytes.

    Args:
        image: Projected vertices [px], shape [V, 2].
        faces: Corners, shape [F, 3].
        size: Width and height of the mask.
        low: Photo coordinates of the mask's upper left corner, (0, 0) by default.
        scale: Mask pixels a photo pixel.
    """
    mask = np.zeros(size[::-1], np.uint8)
    placed = (image - (0 if low is None else low)) * scale - 0.5  # OpenCV counts from the centre of a pixel
    corners = np.round(placed * (1 << _SUBPIXEL_BITS)).astype(np.int32)
    for triangle in corners[facing(image, faces)]:
        cv2.fillConvexPoly(mask, triangle, 255, cv2.LINE_8, _SUBPIXEL_BITS)
    return mask
