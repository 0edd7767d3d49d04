"""Measure how well the bundled hand bends with and without its pose correctives, as Markdown tables; draw its poses.

python asset_build/measure_hand.py --pictures docs/_static
"""

import argparse
import dataclasses
from pathlib import Path

import cv2
import igl
import numpy as np
import torch
from hand_build.anatomy import Array, Index
from hand_build.quality import enclosed_volume, self_crossings

from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.types import HandPose
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand

Image = np.ndarray
"""Blue, green, red in 8 bits, [H, W, 3]."""

# Rows: right, down and away from the eye, in the hand's frame. Fingers point up.
PALM = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
BACK = np.array([[0, 0, -1.0], [1, 0, 0], [0, -1, 0]])
THUMB_SIDE = np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, -1]])
SKEW = np.array([[0.57, 0, 0.82], [0, 1, 0], [-0.82, 0, 0.57]]) @ PALM
VIEWS = (PALM, BACK, THUMB_SIDE, SKEW)

SKIN_BGR, INSIDE_BGR = np.array([150, 180, 225.0]), np.array([120, 30, 150.0])
LIGHT = np.array([-0.36, -0.52, -0.77])
CENTRE = np.array([-0.085, 0, 0])
SPAN = 0.23
"""Width of a picture [m]."""
SUBPIXEL_BITS = 4
CORRECTED_POSES = ("fist", "thumbs_up", "pinch", "ok", "open")


def posed(hand: HandModel, angles: torch.Tensor) -> Array:
    """Vertices of the mean hand with joint `angles`, not moved as a whole."""
    pose = HandPose(angles, torch.eye(3).to(angles), torch.zeros(3).to(angles))
    return skin(hand, rest_hand(hand, torch.zeros(len(hand.shape_names)).to(angles)), pose).vertices.numpy()


def pose_row(hand: HandModel, name: str) -> tuple[float, int]:
    """Volume [cm^3] and crossing edges of a named pose."""
    vertices = posed(hand, named_pose(hand, name))
    faces = hand.faces.numpy()
    return 1e6 * enclosed_volume(vertices, faces, hand.rim.numpy()), self_crossings(vertices, faces)


def draw(vertices: Array, faces: Index, view: Array, size: int) -> Image:
    """The surface in orthographic projection, [size, size, 3], drawn from back to front at twice the size."""
    fine = 2 * size
    at = (vertices - CENTRE) @ view.T
    normals = np.cross(at[faces[:, 1]] - at[faces[:, 0]], at[faces[:, 2]] - at[faces[:, 0]])
    smooth = np.asarray(igl.per_vertex_normals(at, faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA))
    shading = smooth[faces].mean(1)
    shading /= np.linalg.norm(shading, axis=1, keepdims=True)
    brightness = 0.28 + 0.75 * np.clip(shading @ LIGHT, 0, 1)
    colors = np.where(normals[:, 2:] > 0, INSIDE_BGR, np.clip(brightness[:, None] * SKIN_BGR, 0, 255))
    pixels = at[:, :2] * fine / SPAN + fine / 2
    corners = np.round(pixels[faces] * 2**SUBPIXEL_BITS).astype(np.int32)
    image = np.full((fine, fine, 3), 255, np.uint8)
    for face in np.argsort(-at[faces, 2].mean(1), kind="stable"):
        cv2.fillConvexPoly(image, corners[face], colors[face].tolist(), cv2.LINE_8, SUBPIXEL_BITS)
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)


def pose_strip(hand: HandModel, name: str, size: int) -> Image:
    """A named pose from all sides, side by side."""
    vertices = posed(hand, named_pose(hand, name))
    return np.hstack([draw(vertices, hand.faces.numpy(), view, size) for view in VIEWS])


def label(image: Image, text: str) -> Image:
    """The image with a word in its corner."""
    return cv2.putText(image, text, (5, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)


def write_pictures(folder: Path, plain: HandModel, full: HandModel) -> None:
    """Write `hand_poses.png`, and `hand_correctives.png` without and with pose correctives."""
    strips = [label(pose_strip(full, name, 170), name) for name in POSE_NAMES]
    half = (len(strips) + 1) // 2
    strips += [np.full_like(strips[0], 255)] * (2 * half - len(strips))
    cv2.imwrite(str(folder / "hand_poses.png"), np.hstack([np.vstack(strips[:half]), np.vstack(strips[half:])]))
    rows = []
    for name in CORRECTED_POSES:
        before, after = (pose_strip(hand, name, 190) for hand in (plain, full))
        rows.append(np.hstack([label(before, f"{name}, before"), label(after, "after")]))
    cv2.imwrite(str(folder / "hand_correctives.png"), np.vstack(rows))


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the poses")
    args = parser.parse_args()
    full = bundled_hand().to(dtype=torch.float64)
    plain = dataclasses.replace(full, corrective_basis=full.corrective_basis[..., :0])
    print("| pose | volume before [cm^3] | after | crossing edges before | after |\n|---|---|---|---|---|")
    for name in POSE_NAMES:
        (volume, crossings), (volume_after, crossings_after) = pose_row(plain, name), pose_row(full, name)
        print(f"| {name} | {volume:.0f} | {volume_after:.0f} | {crossings} | {crossings_after} |")
    if args.pictures is not None:
        write_pictures(args.pictures, plain, full)


if __name__ == "__main__":
    main()
