"""Damage photos on purpose and see what becomes of their avatars.

    python studies/stress_one_shot.py tests/data/photos/{palm_open_left_02.png,back_flat_right_04.jpg} --out out/stress
    python studies/stress_one_shot.py tests/data/photos/palm_open_left_02.png --out out/seeds --repeats 10 --seeds 20

Writes stress.json and prints a table: likeness of each avatar to its own, damaged photo (inside the outline), and
likeness of its pictures in the open pose, from the photo's side and from behind and after one gain a channel, to those
of the avatar of the undamaged photo; what was refused without --force, and what is newly warned about. "synthetic:K" is
person K of the held-out synthetic hands, photographed in even light before a plain wall. With --repeats and --seeds the
same photo is done again with the same seed, which must give the same bits, and with other seeds.
"""

import argparse
import json
import math
import tempfile
from pathlib import Path

import torch
from named_photos import photo_of
from stresses import STRESSES, Stressed, write_keypoints

from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import BLACK, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import CanonicalGaussians
from oasis_warp.data.output_files import write_file
from oasis_warp.evaluation.metrics import match_colors
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from oasis_warp.reconstruction import Reconstruction, reconstruct

SYNTHETIC_SIZE = 512
VIEW_SIZE = 256
LARGEST = 0.05
"""Standard deviation beyond which a Gaussian has exploded [m]."""


def make(stressed: Stressed, config: ReconstructConfig, *, force: bool) -> Reconstruction:
    """Reconstruct a stressed photo."""
    forced = ReconstructConfig(**{**vars(config), "force": force})
    with tempfile.TemporaryDirectory() as folder:
        return reconstruct(stressed.photo, forced, keypoints=write_keypoints(stressed, Path(folder)))


def is_sane(gaussians: CanonicalGaussians) -> bool:
    """Whether every number is finite, every colour a colour and no Gaussian larger than `LARGEST`."""
    finite = all(bool(part.isfinite().all()) for part in gaussians if part is not None)
    colors = gaussians.colors
    return finite and bool(((colors >= 0) & (colors <= 1)).all()) and float(gaussians.scales.max()) < LARGEST


@torch.no_grad()
def likeness(avatar: Avatar, other: Avatar) -> float:
    """PSNR of two avatars' open hands, from in front and behind, where both are, after one gain a channel [dB].

    An avatar takes the light of its photo, so that a lamp of another colour is no damage in itself.
    """
    drawn = []
    for each in (avatar, other):
        pose = avatar.source_pose._replace(angles=named_pose(each.hand, "open"))
        around = each.mesh(pose).vertices
        drawn.append([each.render(orbit_camera(around, turn, size=VIEW_SIZE), pose, BLACK) for turn in (0.0, math.pi)])
    images, others = (torch.cat([view.image for view in views]) for views in drawn)
    inside = torch.cat([(a.alpha > 0.99) & (b.alpha > 0.99) for a, b in zip(*drawn, strict=True)])
    return masked_psnr(match_colors(others, images, inside.float()), images, inside.float())


def stress_photo(name: str, config: ReconstructConfig) -> list[dict[str, object]]:
    """A row for the photo as it is and one for each stress."""
    photo = photo_of(name, SYNTHETIC_SIZE, config.device)
    base = reconstruct(photo, config)
    rows = [row_of(name, "none", base, base, "")]
    print(line(rows[-1]), flush=True)
    for title, stress in STRESSES.items():
        stressed, refused = stress(photo, base), ""
        try:
            made = make(stressed, config, force=False)
        except InputError as error:
            refused = str(error)
            try:
                made = make(stressed, config, force=True)
            except InputError as final:
                rows.append({"photo": name, "stress": title, "refused": f"even by force: {final}"})
                print(line(rows[-1]), flush=True)
                continue
        rows.append(row_of(name, title, made, base, refused))
        print(line(rows[-1]), flush=True)
    return rows


def row_of(name: str, stress: str, made: Reconstruction, base: Reconstruction, refused: str) -> dict[str, object]:
    """What is measured of one avatar."""
    return {
        "photo": name,
        "stress": stress,
        "refused": refused,
        "own_db": made.errors["input_psnr_inner_db"],
        "like_db": likeness(base.avatar, made.avatar) if made is not base else math.inf,
        "mask_iou": made.errors["mask_iou"],
        "seen": made.errors["seen_percent"],
        "uncertainty": made.errors["uncertainty_mean"],
        "sane": is_sane(made.avatar.gaussians),
        "warnings": [words for words in made.warnings if stress == "none" or words not in base.warnings],
    }


COLUMNS = ("photo", "stress", "own photo, dB", "undamaged avatar, dB", "IoU", "seen, %", "uncertain", "said")


def line(row: dict) -> str:
    """A line of the table."""
    said = ([f"refused: {row['refused'].split(': ', 1)[-1]}"] if row["refused"] else []) + row.get("warnings", [])
    if "own_db" not in row:
        return f"| {Path(row['photo']).stem} | {row['stress']} | | | | | | {'; '.join(said)} |"
    numbers = f"{row['own_db']:.1f} | {row['like_db']:.1f} | {row['mask_iou']:.2f} | {row['seen']:.0f}"
    broken = "" if row["sane"] else " **not finite or exploded**"
    words = "; ".join(said) + broken
    return f"| {Path(row['photo']).stem} | {row['stress']} | {numbers} | {row['uncertainty']:.2f} | {words} |"


def repeat(name: str, config: ReconstructConfig, repeats: int, seeds: int) -> dict[str, object]:
    """Whether `repeats` fits with one seed have the same bits, and the input PSNR of `seeds` others."""
    photo = photo_of(name, SYNTHETIC_SIZE, config.device)
    first, same = reconstruct(photo, config), True
    for _ in range(repeats - 1):
        again = reconstruct(photo, config).avatar.gaussians
        pairs = zip(first.avatar.gaussians, again, strict=True)
        same &= all(torch.equal(a, b) for a, b in pairs)
    found = [
        reconstruct(photo, ReconstructConfig(**{**vars(config), "seed": seed})).errors["input_psnr_inner_db"]
        for seed in range(seeds)
    ]
    spread = max(found) - min(found) if found else 0.0
    print(f"{name}: {repeats} fits {'have the same bits' if same else 'DIFFER'}; {seeds} seeds spread {spread:.3f} dB")
    return {"photo": name, "repeats": repeats, "same_bits": same, "seeds": found, "spread_db": spread}


def main() -> None:
    """Stress every photo, or repeat it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+", help="files, or synthetic:K")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--prior", default="learned", help="learned, none or a weights file")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--steps", type=int, help="of texture learning; stops by itself when not given")
    parser.add_argument("--repeats", type=int, default=0, help="fits with the same seed, instead of stresses")
    parser.add_argument("--seeds", type=int, default=0, help="fits with other seeds, instead of stresses")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    prior = options.prior if options.prior in ("learned", "none") else Path(options.prior)
    config = ReconstructConfig(prior=prior, device=options.device, steps=options.steps)
    if options.repeats or options.seeds:
        found = [repeat(name, config, options.repeats, options.seeds) for name in options.photos]
    else:
        print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
        found = [row for name in options.photos for row in stress_photo(name, config)]
    write_file(options.out / "stress.json", json.dumps(found, indent=1).encode())


if __name__ == "__main__":
    main()
