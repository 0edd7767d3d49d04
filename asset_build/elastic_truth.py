"""Bend the bundled hand as flesh on bones: the truth of `measure_correctives.py`.

    python asset_build/elastic_truth.py out/truth

Writes one file a pose, and goes on where it stopped. Prints for the last step of each pose: flesh kept, share of it
turned inside out, volume inside the skin, edges that cross other faces. Half an hour on a busy core.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from elastic_hand import solid, truths
from elastic_hand.flesh import Flesh
from elastic_hand.solid import MILLIMETRES, SkinMap
from hand_build.quality import enclosed_volume, self_crossings

from oasis_warp.core.hand_model import HandModel
from oasis_warp.hand.template import bundled_hand


def bend(hand: HandModel, flesh: Flesh, skin: SkinMap, task: truths.Bend) -> truths.Truth:
    """The flesh at every step on the way to a pose."""
    nodes, before = flesh.solid.nodes, truths.bones(hand, 0 * task.angles)
    angles, vertices, swelling = [], [], []
    for step in range(1, task.steps + 1):
        angles.append(task.angles * step / task.steps)
        after = truths.bones(hand, angles[-1])
        nodes = flesh.bend(nodes, before, after)
        vertices.append(skin.surface(nodes, after) / MILLIMETRES)
        swelling.append(flesh.swelling(nodes))
        before = after
    share, swelling = flesh.volume / flesh.volume.sum(), np.stack(swelling)
    return truths.Truth(
        task.name, task.part, np.stack(angles), np.stack(vertices), swelling @ share, (swelling < 0) @ share
    )


def main() -> None:
    """Bend and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", help="names of poses")
    parser.add_argument("--bone-share", type=float, default=solid.BONE_SHARE, help="thickness of bones in fingers")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    hand = bundled_hand().to(dtype=torch.float64)
    flesh = Flesh(solid.fill(hand, args.bone_share))
    skin = SkinMap(hand, flesh.solid)
    faces, rim = hand.faces.numpy(), hand.rim.numpy()
    print("| pose | flesh kept | inside out | volume [cm^3] | crossing edges | s |\n|---|---|---|---|---|---|")
    for task in truths.bends(hand):
        if (args.only is not None and task.name not in args.only) or (args.folder / f"{task.name}.npz").exists():
            continue
        start = time.perf_counter()
        truth = bend(hand, flesh, skin, task)
        truths.save(args.folder, truth)
        last = truth.vertices[-1]
        volume = 1e6 * enclosed_volume(last, faces, rim)
        print(
            f"| {truth.name} | {truth.kept[-1]:.2%} | {truth.inverted[-1]:.3%} | {volume:.0f} "
            f"| {self_crossings(last, faces)} | {time.perf_counter() - start:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
