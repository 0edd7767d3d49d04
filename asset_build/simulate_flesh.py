"""Bend the bundled hand as flesh on bones, the reference that `fit_correctives.py` fits to.

    python asset_build/simulate_flesh.py out/flesh

Writes one file a pose, and goes on where it stopped. Prints for the last step of each pose: flesh kept, share of it
turned inside out, volume inside the skin, edges that cross other faces. Half an hour on a busy core.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from elastic_hand import simulations, solid
from elastic_hand.flesh import Flesh
from elastic_hand.solid import MILLIMETRES, SkinMap
from hand_build.quality import enclosed_volume, self_crossings

from oasis_warp.core.hand_model import HandModel
from oasis_warp.hand.template import bundled_hand


def bend(hand: HandModel, flesh: Flesh, skin: SkinMap, task: simulations.Bend) -> simulations.Simulation:
    """The flesh at every step on the way to a pose."""
    nodes, before = flesh.solid.nodes, simulations.bones(hand, 0 * task.angles)
    angles, vertices, swelling = [], [], []
    for step in range(1, task.steps + 1):
        angles.append(task.angles * step / task.steps)
        after = simulations.bones(hand, angles[-1])
        nodes = flesh.bend(nodes, before, after)
        vertices.append(skin.surface(nodes, after) / MILLIMETRES)
        swelling.append(flesh.swelling(nodes))
        before = after
    share, swelling = flesh.volume / flesh.volume.sum(), np.stack(swelling)
    return simulations.Simulation(
        task.name, task.part, np.stack(angles), np.stack(vertices), swelling @ share, (swelling < 0) @ share
    )


def main() -> None:
    """Bend and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    hand = bundled_hand().to(dtype=torch.float64)
    flesh = Flesh(solid.fill(hand))
    skin = SkinMap(hand, flesh.solid)
    faces, rim = hand.faces.numpy(), hand.rim.numpy()
    print("| pose | flesh kept | inside out | volume [cm^3] | crossing edges | s |\n|---|---|---|---|---|---|")
    for task in simulations.bends(hand):
        if (args.folder / f"{task.name}.npz").exists():
            continue
        start = time.perf_counter()
        made = bend(hand, flesh, skin, task)
        simulations.save(args.folder, made)
        last = made.vertices[-1]
        volume = 1e6 * enclosed_volume(last, faces, rim)
        print(
            f"| {made.name} | {made.kept[-1]:.2%} | {made.inverted[-1]:.3%} | {volume:.0f} "
            f"| {self_crossings(last, faces)} | {time.perf_counter() - start:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
