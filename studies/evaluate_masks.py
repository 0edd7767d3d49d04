"""Hold the automatic masks and the fitted surfaces against the hand-drawn outlines of ten photos.

    python studies/evaluate_masks.py tests/data/photos --out out/masks.md

IoU above the wrist line of the landmarks: of the mask the estimator cuts, of the mesh it fits, of that mesh after its
outline was moved onto the mask (what the avatar is made on), and for comparison of mesh and automatic mask.
"""

import argparse
import statistics
from pathlib import Path

import torch
from hand_drawn_masks import read_masks

from oasis_warp.core.mirror import mirror_points, mirror_pose
from oasis_warp.core.types import HandFit, HandPose
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.surface_offsets import outline_offsets
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import depth_map

OUTLINES = Path(__file__).parents[1] / "tests" / "data" / "masks" / "outlines.json"
COLUMNS = ("automatic mask", "fitted mesh", "mesh on the outline", "mesh against automatic mask")


def drawn_mesh(fit: HandFit, offsets: torch.Tensor) -> torch.Tensor:
    """Pixels [H, W] that the fitted surface covers in the photo."""
    hand = bundled_hand()
    rest = rest_hand(hand, fit.shape)
    pose: HandPose = mirror_pose(fit.pose) if fit.side == "left" else fit.pose
    vertices = skin(hand, rest._replace(vertices=rest.vertices + offsets), pose).vertices
    vertices = mirror_points(vertices) if fit.side == "left" else vertices
    camera = fit.camera
    return depth_map(vertices, hand.faces, camera.viewmat, camera.K, camera.width, camera.height).face_ids >= 0


def iou(a: torch.Tensor, b: torch.Tensor, where: torch.Tensor) -> float:
    """Intersection over union inside `where`."""
    return float((a & b & where).sum() / ((a | b) & where).sum())


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    estimator = HandEstimator(bundled_hand())
    rows: list[tuple[str, list[float]]] = []
    for name, coverage in sorted(read_masks(OUTLINES).items()):
        path = next(p for p in options.photos.iterdir() if p.stem == name)
        photo = read_photo(path)
        fit = estimator.fit(photo, choose_hand(estimator.find(photo), "largest", photo.name), force=True)
        where = torch.from_numpy(wrist_line(fit.landmarks.xy.numpy()).above_mask((fit.camera.width, fit.camera.height)))
        truth, mask = torch.from_numpy(coverage) > 0.5, fit.mask > 0.5
        offsets = outline_offsets(bundled_hand(), fit)
        plain, moved = drawn_mesh(fit, torch.zeros_like(offsets)), drawn_mesh(fit, offsets)
        rows.append((name, [iou(m, truth, where) for m in (mask, plain, moved)] + [iou(moved, mask, where)]))
    lines = ["| photo | " + " | ".join(COLUMNS) + " |", "|---|" + "---|" * len(COLUMNS)]
    lines += [f"| {name} | " + " | ".join(f"{v:.3f}" for v in values) + " |" for name, values in rows]
    columns = zip(*(values for _, values in rows), strict=True)
    lines.append("| **median** | " + " | ".join(f"{statistics.median(column):.3f}" for column in columns) + " |")
    print("\n".join(lines))
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
