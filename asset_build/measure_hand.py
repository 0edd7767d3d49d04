"""Measure how well the bundled hand bends with and without its pose correctives, as a Markdown table; draw its poses.

python asset_build/measure_hand.py --pictures docs/_static
"""

import argparse
import dataclasses
import math
from itertools import zip_longest
from pathlib import Path

import numpy as np
import torch
from hand_build.quality import enclosed_volume, self_crossings

from oasis_warp.cli.summary import Panel, draw_mesh, make_sheet, panel_side, shade_mesh
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose, PosedHand
from oasis_warp.data.pictures import write_picture
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand

FACING = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Fingers up, palm to the camera."""
AZIMUTHS = (0.0, math.pi, math.pi / 2, math.pi / 5)
"""Of the views: palm, back, the thumb's side and between [rad]."""
CORRECTED_POSES = ("fist", "thumbs_up", "pinch", "ok", "open")
WIDTH = 1500
"""Of the pictures [px]."""


def posed(hand: HandModel, name: str) -> PosedHand:
    """The mean hand in a named pose."""
    angles = named_pose(hand, name)
    pose = HandPose(angles, FACING.to(angles), torch.tensor([0.0, 0.0, 0.5]).to(angles))
    return skin(hand, rest_hand(hand, torch.zeros(len(hand.shape_names)).to(angles)), pose)


def measure(hand: HandModel, name: str) -> tuple[float, int]:
    """Volume [cm^3] and crossing edges of a named pose."""
    vertices, faces = posed(hand, name).vertices.numpy(), hand.faces.numpy()
    return 1e6 * enclosed_volume(vertices, faces, hand.rim.numpy()), self_crossings(vertices, faces)


def views(hand: HandModel, name: str, label: str, side: int) -> list[Panel]:
    """A named pose from all sides."""
    hand, panels = hand.to(dtype=torch.float32), []
    surface = posed(hand, name)
    for azimuth in AZIMUTHS:
        camera = orbit_camera(surface.vertices, azimuth, size=side)
        shade, inside = shade_mesh(surface, hand.faces, camera)
        white = np.full((side, side, 3), 255, np.uint8)
        panels.append(Panel(draw_mesh(white, shade.numpy(), inside.numpy() > 0, 1.0), label))
    return panels


def write_pictures(folder: Path, plain: HandModel, full: HandModel) -> None:
    """Write `hand_poses.png`, and `hand_correctives.png` without and with pose correctives."""
    side = panel_side(2 * len(AZIMUTHS), WIDTH)
    strips = [views(full, name, name, side) for name in POSE_NAMES]
    blank = [Panel(np.full((side, side, 3), 255, np.uint8), "")] * len(AZIMUTHS)
    poses = [one + other for one, other in zip_longest(strips[::2], strips[1::2], fillvalue=blank)]
    pairs = [views(plain, name, f"{name}, before", side) + views(full, name, "after", side) for name in CORRECTED_POSES]
    for file, title, rows in (("hand_poses", "Named poses", poses), ("hand_correctives", "Pose correctives", pairs)):
        write_picture(folder / f"{file}.png", torch.from_numpy(make_sheet(title, "", rows, WIDTH)))


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the poses")
    args = parser.parse_args()
    full = bundled_hand().to(dtype=torch.float64)
    plain = dataclasses.replace(full, corrective_basis=full.corrective_basis[..., :0])
    print("| pose | volume before [cm^3] | after | crossing edges before | after |\n|---|---|---|---|---|")
    for name in POSE_NAMES:
        (volume, crossings), (volume_after, crossings_after) = measure(plain, name), measure(full, name)
        print(f"| {name} | {volume:.0f} | {volume_after:.0f} | {crossings} | {crossings_after} |")
    if args.pictures is not None:
        write_pictures(args.pictures, plain, full)


if __name__ == "__main__":
    main()
