"""Fit the hand's pose correctives to flesh on bones and put them into its file.

    python asset_build/build_hand.py --out out/hand.npz
    python asset_build/elastic_truth.py out/truth
    python asset_build/fit_correctives.py out/truth --hand out/hand.npz --out src/oasis_warp/assets/hand/hand_right.npz

The file given may hold correctives already: they are left out of account and replaced. It prints the digest that
`src/oasis_warp/assets/hand/SHA256` has to hold.
"""

import argparse
from pathlib import Path

import numpy as np
import scipy.sparse as sp
import torch
from elastic_hand import truths
from elastic_hand.methods import fit_to_flesh
from elastic_hand.solid import MILLIMETRES
from hand_build.source import write_npz

from oasis_warp.hand.template import bundled_hand

N_GESTURES, SEED = 50, 5
"""Gestures in which nothing shall lie inside, apart from those that flesh was bent to."""


def main() -> None:
    """Fit and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--hand", type=Path, required=True, help="file of the hand")
    parser.add_argument("--out", type=Path, required=True, help="file to write, .npz")
    args = parser.parse_args()
    with np.load(args.hand) as stored:
        arrays = {key: stored[key] for key in stored.files}
    n_fine, n_base = (int(n) for n in arrays["hd_shape"])
    subdivision = sp.csr_matrix(
        (arrays["hd_data"].astype(float), arrays["hd_indices"].astype(np.int64), arrays["hd_indptr"]), (n_fine, n_base)
    )
    hand = bundled_hand().to(dtype=torch.float64)
    learnt = [t for t in truths.load(args.truth) if t.part == truths.TRAIN]
    shapes = fit_to_flesh(hand, subdivision, learnt, truths.gestures(hand, N_GESTURES, SEED))
    correctives = np.zeros((n_base + 1, 3, len(shapes)), np.float16)  # the last vertex only closes the wrist
    correctives[:n_base] = shapes.transpose(1, 2, 0) / MILLIMETRES
    digest = write_npz(args.out, {**arrays, "correctives": correctives})
    print(f"{digest}  {args.out.name}")


if __name__ == "__main__":
    main()
