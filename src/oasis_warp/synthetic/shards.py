"""Write data sets of pictures: tar files in the WebDataset layout, atomic and reproducible to the byte.

Picture i has four members: `i.jpg`, `i.mask.png` (share of the pixel that is hand), `i.depth.png` (16 bits, tenths of a
millimetre, 0 for none) and `i.json` with the ground truth.
"""

import io
import json
import tarfile
from pathlib import Path

import cv2
import numpy as np
import torch

from oasis_warp.core.logging import Progress, silent
from oasis_warp.data.output_files import open_resumable_folder, output_file
from oasis_warp.synthetic.picture import SyntheticBatch, render_batch
from oasis_warp.synthetic.shots import SceneConfig

SHARD = 64
"""Pictures per file: a whole number of people."""
JPEG_QUALITY = 95
DEPTH_UNIT = 1e-4
"""Unit of the depth images [m]."""
DESCRIPTION = "dataset.json"


def shard_name(number: int) -> str:
    """File name of shard `number`."""
    return f"hands-{number:06d}.tar"


def write_shards(
    folder: Path, *, count: int, seed: int, size: int, device: str, scene: SceneConfig, batch: int,
    progress: Progress = silent,
) -> int:  # fmt: skip
    """Render pictures 0 to `count` - 1 into shards of `folder`, and return the number of new ones.

    Shards that exist already stay. A stopped run continues where it was, and ends with the same files.

    Args:
        folder: Created if needed.
        count: Number of pictures.
        seed: Seed of the world.
        size: Side of the pictures [px].
        device: Where to compute.
        scene: What the pictures show.
        batch: Pictures rendered together.
        progress: Called after every batch.

    Raises:
        InputError: the folder holds other pictures, or cannot be written.
    """
    backgrounds = [path.name for path in scene.backgrounds]
    settings = {"seed": seed, "size": size, "shard": SHARD, "look": scene.look, "backgrounds": backgrounds}
    open_resumable_folder(folder, DESCRIPTION, settings, "pictures")
    n_shards = -(-count // SHARD)
    made = 0
    for number in range(n_shards):
        first, end = number * SHARD, min((number + 1) * SHARD, count)
        path = folder / shard_name(number)
        if path.is_file() and _count_pictures(path) == end - first:
            progress("pictures", end, count)
            continue
        with output_file(path) as part, tarfile.open(part, "w", format=tarfile.USTAR_FORMAT) as tar:
            for start in range(first, end, batch):
                indices = range(start, min(start + batch, end))
                rendered = render_batch(seed, indices, size, device, scene=scene)
                for k in range(len(indices)):
                    for name, data in encode(rendered, k).items():
                        member = tarfile.TarInfo(f"{indices[k]:08d}.{name}")
                        member.size = len(data)
                        tar.addfile(member, io.BytesIO(data))
                made += len(indices)
                progress("pictures", indices[-1] + 1, count)
    return made


def _count_pictures(path: Path) -> int:
    """Number of pictures in a shard; none in a damaged one, which is written again."""
    try:
        with tarfile.open(path, "r:") as tar:
            return sum(name.endswith(".json") for name in tar.getnames())
    except (tarfile.TarError, OSError):
        return 0


def encode(batch: SyntheticBatch, k: int) -> dict[str, bytes]:
    """Picture `k` of a batch as files, by the suffix of their names."""
    rgb = (batch.image[k].cpu() * 255).round().to(torch.uint8).numpy()
    mask = (batch.mask[k].cpu() * 255).round().to(torch.uint8).numpy()
    depth = batch.depth[k].cpu().numpy().astype(np.float64)
    depth = np.where(np.isfinite(depth), np.clip(np.round(depth / DEPTH_UNIT), 1, 65535), 0).astype(np.uint16)
    truth = {
        "index": int(batch.index[k]),
        "person": int(batch.person[k]),
        "side": "left" if int(batch.left[k]) else "right",
        "gesture": batch.gestures[k],
        "landmarks": _rounded(batch.landmarks[k], 3),
        "landmarks_3d": _rounded(batch.landmarks_3d[k], 6),
        "angles": _rounded(batch.angles[k], 6),
        "orientation": _rounded(batch.orientation[k], 7),
        "translation": _rounded(batch.translation[k], 6),
        "shape": _rounded(batch.shape[k], 6),
        "K": _rounded(batch.K[k], 4),
    }
    _, jpg = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return {
        "jpg": jpg.tobytes(),
        "mask.png": cv2.imencode(".png", mask)[1].tobytes(),
        "depth.png": cv2.imencode(".png", depth)[1].tobytes(),
        "json": (json.dumps(truth) + "\n").encode(),
    }


def _rounded(tensor: torch.Tensor, digits: int) -> list:
    return np.round(tensor.cpu().double().numpy(), digits).tolist()
