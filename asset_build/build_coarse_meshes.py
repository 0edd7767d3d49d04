"""Build the coarse meshes on which the sky is computed: of the posed hand, and of hand and forearm in pictures.

    python asset_build/build_coarse_meshes.py sky_mesh --out src/oasis_warp/assets/hand/sky_mesh.npz
    python asset_build/build_coarse_meshes.py coarse_body --out src/oasis_warp/assets/synthetic/coarse_body.npz

Edges are collapsed by libigl until `FACES` are left. The results ship with the package, so that pictures are made where
libigl is not installed.
"""

import argparse
from pathlib import Path

import igl
import numpy as np
from hand_build.source import write_npz

from oasis_warp.core.hand_model import HandModel
from oasis_warp.hand.template import bundled_hand
from oasis_warp.synthetic.body import SkinMesh, skin_mesh

FACES = 4000
"""Edges of 4 mm: a quarter of a finger's width."""


def coarse_mesh(skin: SkinMesh) -> dict[str, np.ndarray]:
    """Numbers of the vertices that are kept, and the faces between them, as uint16."""
    _, left, _, kept = igl.decimate(skin.rest.double().numpy(), skin.faces.numpy(), FACES, False)
    return {"vertices": np.asarray(kept, np.uint16), "faces": np.asarray(left, np.uint16)}


def sky_mesh(hand: HandModel) -> dict[str, np.ndarray]:
    """See `oasis_warp.avatar.sky.SkyMesh`; a fine vertex reads the corners of the coarse face nearest to it at rest."""
    points, faces = hand.template.double().numpy(), hand.faces.numpy()
    _, left, _, kept = igl.decimate(points, faces, FACES, False)
    kept, left = np.asarray(kept), np.asarray(left, np.int64)
    coarse = points[kept]
    _, nearest, at = igl.point_mesh_squared_distance(points, coarse, left)
    corners = left[nearest]
    a, b, c = (np.ascontiguousarray(coarse[corners[:, k]]) for k in range(3))
    weights = igl.barycentric_coordinates(np.ascontiguousarray(at), a, b, c).clip(0, 1)
    weights /= weights.sum(1, keepdims=True)
    return {
        "vertices": kept.astype(np.uint16),
        "faces": left.astype(np.uint16),
        "corners": corners.astype(np.uint16),
        "weights": weights.astype(np.float32),
        "still": hand.weights[:, 0].argmax().numpy().astype(np.uint16),
    }


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", choices=("sky_mesh", "coarse_body"))
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    made = sky_mesh(bundled_hand()) if args.mesh == "sky_mesh" else coarse_mesh(skin_mesh(bundled_hand()))
    print(write_npz(args.out, made), args.out)


if __name__ == "__main__":
    main()
