"""Fit the hand's pose correctives to flesh on bones and put them into its file.

    python asset_build/build_hand.py --out out/hand.npz
    python asset_build/simulate_flesh.py out/flesh
    python asset_build/fit_correctives.py out/flesh --hand out/hand.npz --out src/oasis_warp/assets/hand/hand_right.npz

The file given may hold correctives already: they are left out of account and replaced. Knuckles, which the flesh does
not have, are added to what is fitted. It prints the digest that `src/oasis_warp/assets/hand/SHA256` has to hold, and
how far skinning with and without the fitted correctives is from the flesh in poses that they were not fitted to.
"""

import argparse
from pathlib import Path

import igl
import numpy as np
import scipy.sparse as sp
import torch
from elastic_hand import simulations
from elastic_hand.correctives import fit_to_flesh, strengths
from elastic_hand.solid import MILLIMETRES, skinned
from hand_build.anatomy import Array
from hand_build.knuckles import knuckle_shapes
from hand_build.rig import moving_share
from hand_build.source import write_npz

from oasis_warp.core.hand_model import HandModel
from oasis_warp.hand.template import bundled_hand

N_GESTURES, SEED = 50, 5
"""Gestures in which nothing shall lie inside, apart from those that flesh was bent to."""
BLENDED = 0.9
"""A vertex lies near a joint where no bone holds more of it."""


def distances(hand: HandModel, shapes: Array, judged: list[simulations.Simulation]) -> Array:
    """From the flesh at the end of each bend, of vertices near joints [mm]; `shapes` are [C, V, 3]."""
    rest, weights = hand.template.numpy() * MILLIMETRES, hand.weights.numpy()
    near, found = weights.max(1) < BLENDED, []
    for made in judged:
        displaced = rest + np.tensordot(strengths(hand, made.angles[-1]), shapes, 1)
        surface = skinned(displaced, weights, simulations.bones(hand, made.angles[-1]))
        found.append(np.linalg.norm(surface - made.vertices[-1] * MILLIMETRES, axis=1)[near])
    return np.concatenate(found)


def main() -> None:
    """Fit and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flesh", type=Path, help="folder of simulations")
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
    made = simulations.load(args.flesh)
    learnt, judged = ([m for m in made if m.part == part] for part in (simulations.TRAIN, simulations.HELD_OUT))
    shapes = fit_to_flesh(hand, subdivision, learnt, simulations.gestures(hand, N_GESTURES, SEED))
    rest, faces = arrays["v_template"][:n_base].astype(float), arrays["faces"].astype(np.int64)
    normals = np.asarray(igl.per_vertex_normals(rest, faces))
    shapes = shapes * moving_share(rest, igl.boundary_loop(faces))[:, None]
    raised = shapes + knuckle_shapes(hand, rest * MILLIMETRES, normals)
    correctives = np.zeros((n_base + 1, 3, len(shapes)), np.float16)  # the last vertex only closes the wrist
    correctives[:n_base] = raised.transpose(1, 2, 0) / MILLIMETRES
    digest = write_npz(args.out, {**arrays, "correctives": correctives})
    print(f"{digest}  {args.out.name}")
    fine = np.stack([subdivision @ shape for shape in shapes])
    for name, used in (("blend skinning", 0 * fine), ("with correctives", fine)):
        off = distances(hand, used, judged)
        print(f"{name}: mean {off.mean():.2f} mm, 99 % {np.percentile(off, 99):.1f} mm, largest {off.max():.1f} mm")


if __name__ == "__main__":
    main()
