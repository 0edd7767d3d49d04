"""Build the coarse mesh of hand and forearm that hides the sky from the vertices of the fine one.

    python asset_build/build_coarse_body.py --out src/oasis_warp/assets/synthetic/coarse_body.npz

Edges are collapsed by libigl until `FACES` are left. The result ships with the package, so that pictures are made
where libigl is not installed.
"""

import argparse
from pathlib import Path

import igl
import numpy as np
from hand_build.source import write_npz

from oasis_warp.hand.template import bundled_hand
from oasis_warp.synthetic.body import SkinMesh, skin_mesh

FACES = 4000


def coarse_mesh(skin: SkinMesh) -> dict[str, np.ndarray]:
    """Numbers of the vertices that are kept, and the faces between them, as uint16."""
    _, left, _, kept = igl.decimate(skin.rest.double().numpy(), skin.faces.numpy(), FACES, False)
    return {"vertices": np.asarray(kept, np.uint16), "faces": np.asarray(left, np.uint16)}


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
    print(write_npz(out, coarse_mesh(skin_mesh(bundled_hand()))), out)


if __name__ == "__main__":
    main()
