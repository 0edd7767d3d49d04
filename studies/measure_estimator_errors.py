"""Estimate synthetic hands as `reconstruction.reconstruct` does, and keep what is true beside what was found.

    python studies/measure_estimator_errors.py out/estimates --count 224

One file a picture, named by its number; those that are there already are left, so a run that was stopped goes on, and
several may share the work by `--first`. `studies/write_estimator_errors.py` reads the folder. Left hands are kept as
the right ones that they are in the mirror.
"""

import argparse
import io
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from oasis_warp.core.errors import InputError
from oasis_warp.core.types import HandFit, Photo
from oasis_warp.data.output_files import write_file
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.estimation.surface_offsets import outline_offsets
from oasis_warp.hand.template import bundled_hand
from oasis_warp.reconstruction import CROP_MARGIN
from oasis_warp.synthetic.picture import SyntheticBatch, render_batch
from oasis_warp.synthetic.shots import PICTURES_EACH

CROP = 256
"""Side of the masks that are kept [px]."""
Row = dict[str, Any]


def in_the_mirror(values: Row, width: int) -> Row:
    """Pose and camera of the mirrored picture."""
    mirror, K = np.array([-1.0, 1.0, 1.0]), values["K"].copy()
    K[0, 2] = width - K[0, 2]
    return values | {
        "orientation": mirror[:, None] * values["orientation"] * mirror,
        "translation": mirror * values["translation"],
        "K": K,
    }


def real(**tensors: Tensor) -> Row:
    """Arrays in double precision."""
    return {name: tensor.double().numpy() for name, tensor in tensors.items()}


def truth(batch: SyntheticBatch) -> Row:
    """Pose and camera of a picture, in its own frame."""
    return real(
        angles=batch.angles[0], orientation=batch.orientation[0], translation=batch.translation[0],
        shape=batch.shape[0], K=batch.K[0],
    )  # fmt: skip


def finding(fit: HandFit) -> Row:
    """What the estimator says of it."""
    return real(**fit.pose._asdict(), shape=fit.shape, K=fit.camera.K)


def estimate(estimator: HandEstimator, seed: int, index: int, size: int) -> Row:
    """Picture `index` of the world `seed`, estimated."""
    batch = render_batch(seed, [index], size)
    side = "left" if int(batch.left[0]) else "right"
    photo = Photo((batch.image[0] * 255).round().to(torch.uint8), None, None, f"picture {index}", 1.0)
    row: Row = {"index": index, "size": size, "side": side, "gesture": batch.gestures[0]}
    hands = estimator.find(photo)
    if not hands:
        return row | {"result": "not found"}
    landmarks = choose_hand(hands, "largest", photo.name)
    if landmarks.side != side:
        return row | {"result": "wrong side"}
    try:
        fit = estimator.fit(photo, landmarks)
    except InputError as error:
        return row | {"result": f"refused: {error}"}
    true, found = truth(batch), finding(fit)
    above = wrist_line(fit.landmarks.xy.numpy()).above_mask((size, size))
    masks = {"true_mask": batch.mask[0], "found_mask": fit.mask, "above": torch.from_numpy(above).float()}
    if side == "left":
        true, found = in_the_mirror(true, size), in_the_mirror(found, size)
        masks = {name: mask.flip(1) for name, mask in masks.items()}
    square = square_around(masks["found_mask"], CROP_MARGIN)
    for name, mask in masks.items():
        cut = resample_square(mask.contiguous(), *square, CROP).clamp(0, 1)
        row[name] = (255 * cut).round().to(torch.uint8).numpy()
    return row | {f"true_{name}": value for name, value in true.items()} | {
        f"found_{name}": value for name, value in found.items()
    } | {
        "result": "fitted",
        "warnings": np.array(fit.warnings, dtype=str),
        "reprojection": fit.reprojection,
        "mask_iou": fit.mask_iou,
        "offsets": outline_offsets(estimator.hand, fit).half().numpy(),
        "square": np.array(square),
        "true_square": np.array(square_around(masks["true_mask"], CROP_MARGIN)),
    }  # fmt: skip


def main() -> None:
    """Estimate what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=224)
    parser.add_argument("--each", type=int, default=2, help=f"pictures of each person, up to {PICTURES_EACH}")
    parser.add_argument("--seed", type=int, default=7001, help="of a world that is not the training's")
    parser.add_argument("--size", type=int, default=384, help="side of the pictures [px]")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.folder.mkdir(parents=True, exist_ok=True)
    estimator = HandEstimator(bundled_hand())
    for k in range(options.first, options.first + options.count):
        path = options.folder / f"{k:05d}.npz"
        if not path.exists():
            index = PICTURES_EACH * (k // options.each) + k % options.each
            row, buffer = estimate(estimator, options.seed, index, options.size), io.BytesIO()
            np.savez_compressed(buffer, **row)
            write_file(path, buffer.getvalue())
            print(f"{path}: {row['result']}", flush=True)


if __name__ == "__main__":
    main()
