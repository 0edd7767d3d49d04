"""Gaussians in glTF: the ratified extension KHR_gaussian_splatting."""

from pathlib import Path

import numpy as np

from oasis_warp.core.color import linear_light
from oasis_warp.data.splat_files import SH_C0
from oasis_warp.export.gltf import VERTICES, GltfBuffer, write_gltf
from oasis_warp.export.request import ExportRequest
from oasis_warp.export.splats import posed_splats

EXTENSION = "KHR_gaussian_splatting"


def write_splat_gltf(request: ExportRequest, path: Path) -> None:
    """Points with scales [m], opacities in [0, 1], quaternions xyzw and the constant harmonic of sRGB; y up.

    Programs without the extension show coloured points.

    Raises:
        InputError: a value is not finite, or `path` cannot be written.
    """
    splats = posed_splats(request)
    means, quats, scales, opacities, colors = (part.numpy().astype("<f4") for part in splats)
    seen = np.concatenate([linear_light(splats.colors.clamp(0, 1)).numpy(), opacities[:, None]], 1)
    buffer = GltfBuffer()
    attributes = {
        "POSITION": buffer.add(means, "VEC3", target=VERTICES),
        "COLOR_0": buffer.add(np.round(255 * seen).astype("u1"), "VEC4", target=VERTICES, normalized=True),
        f"{EXTENSION}:ROTATION": buffer.add(quats[:, [1, 2, 3, 0]], "VEC4", target=VERTICES),
        f"{EXTENSION}:SCALE": buffer.add(scales, "VEC3", target=VERTICES),
        f"{EXTENSION}:OPACITY": buffer.add(opacities, "SCALAR", target=VERTICES),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": buffer.add((colors - 0.5) / np.float32(SH_C0), "VEC3", target=VERTICES),
    }
    looks = {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }  # fmt: skip
    points = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: looks}}
    document = {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "hand", "mesh": 0}],
        "meshes": [{"name": "hand", "primitives": [points]}],
    }
    write_gltf(path, document, buffer)
