"""Build the coarse mesh on which light on a posed hand is computed, and the way back to the fine one.

    python asset_build/build_sky_mesh.py --out src/oasis_warp/assets/hand/sky_mesh.npz

Edges are collapsed by libigl until `FACES` are left. A vertex of the fine mesh reads the three corners of the coarse
face that is nearest to it at rest.
"""

import argparse
from pathlib import Path

import igl
import numpy as np
from hand_build.source import write_npz

from oasis_warp.core.hand_model import HandModel
from oasis_warp.hand.template import bundled_hand

FACES = 4000
"""Edges of 4 mm: a quarter of a finger's width."""


def sky_mesh(hand: HandModel) -> dict[str, np.ndarray]:
    """See `oasis_warp.avatar.sky.SkyMesh`."""
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
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
    print(write_npz(out, sky_mesh(bundled_hand())), out)


if __name__ == "__main__":
    main()
