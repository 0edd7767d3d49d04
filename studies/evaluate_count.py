"""What fewer Gaussians cost where the photo is small, and how many are never seen.

    python studies/evaluate_count.py tests/data/photos/back_flat_right_04.jpg tests/data/photos/palm_open_left_02.png

Each photo is scaled down until the square around its hand has 64, 96, ... pixels, and made into an avatar with a
Gaussian on every vertex and face, and with those of vertices alone (`avatar.densify`). Prints the table of
docs/detail.md: likeness to the photo at its own size, away from the outline; likeness of the second avatar to the first
in other poses, and the area that it covers more than that; frames of 512 px in times of the first's. Then, of the last
usual avatar, how many Gaussians never count for more than so much of any pixel of 384 px in all named poses from 24
sides.
"""

import argparse
import math
from pathlib import Path

import cv2
import torch
from evaluate_detail import file_bytes, frame_times
from jaxtyping import Float
from torch import Tensor

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.avatar.densify import coarsen
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import BLACK, AdaptConfig, ReconstructConfig
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandFit, Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses.image import masked_psnr
from oasis_warp.network.prior import choose_prior
from oasis_warp.reconstruction import crop_hand, crop_side, initial_offsets, input_errors, make_avatar
from oasis_warp.render.render import view_weights

SIZES = (64, 96, 128, 192)
POSES, ROUND, FAR, NEAR = ("open", "fist", "point"), 4, 256, 512
LEAST = (1 / 255, 0.02, 0.05)
UNSEEN_SIZE, UNSEEN_ROUND, ELEVATIONS = 384, 8, (-0.9, 0.0, 0.9)
COLUMNS = (
    "photo", "its own side, px", "likeness, dB", "with fewer", "fewer against all, 256 px", "512 px",
    "area, 512 px", "Gaussians", "fewer", "file, MB", "fewer", "frame",
)  # fmt: skip


def scaled(photo: Photo, factor: float) -> Photo:
    """The photo, smaller."""
    height, width = photo.rgb.shape[:2]
    size = round(width * factor), round(height * factor)

    def smaller(plane: Tensor) -> Tensor:
        return torch.from_numpy(cv2.resize(plane.numpy(), size, interpolation=cv2.INTER_AREA))

    return photo._replace(
        rgb=smaller(photo.rgb),
        alpha=None if photo.alpha is None else smaller(photo.alpha),
        focal=None if photo.focal is None else photo.focal * factor,
    )


@torch.no_grad()
def alike(all_: Avatar, fewer: Avatar, size: int) -> tuple[float, float]:
    """PSNR in other poses from all around [dB], and how much more area is covered [%]."""
    errors, areas = [], []
    for name in POSES:
        pose = all_.source_pose._replace(angles=named_pose(all_.hand, name))
        for k in range(ROUND):
            camera = orbit_camera(all_.mesh(pose).vertices, 2 * math.pi * k / ROUND, 0.3, size)
            one, two = (avatar.render(camera, pose, BLACK) for avatar in (all_, fewer))
            errors.append(10 ** (-masked_psnr(two.image, one.image, (one.alpha > 0.5).float()) / 10))
            areas.append(float(two.alpha.sum() / one.alpha.sum()) - 1)
    return -10 * math.log10(sum(errors) / len(errors)), 100 * sum(areas) / len(areas)


@torch.no_grad()
def most_seen(avatar: Avatar) -> Float[Tensor, "N"]:
    """The largest weight that each Gaussian has in any pixel."""
    most = torch.zeros(len(avatar.gaussians.opacities))
    for name in POSE_NAMES:
        pose = avatar.source_pose._replace(angles=named_pose(avatar.hand, name))
        posed, around = avatar.pose(pose), avatar.mesh(pose).vertices
        for k in range(UNSEEN_ROUND):
            for elevation in ELEVATIONS:
                camera = orbit_camera(around, 2 * math.pi * k / UNSEEN_ROUND, elevation, UNSEEN_SIZE)
                by_gaussian = view_weights(posed, camera).transpose
                rows = torch.repeat_interleave(torch.arange(len(most)), by_gaussian.crow_indices().long().diff())
                most.scatter_reduce_(0, rows, by_gaussian.values(), "amax")
    return most


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--steps", type=int, help="of texture learning; stops by itself when not given")
    options = parser.parse_args()
    hand, prior = bundled_hand(), choose_prior("learned")
    estimator, config = HandEstimator(hand), ReconstructConfig(force=True)

    def fitted(photo: Photo) -> HandFit:
        return estimator.fit(photo, choose_hand(estimator.find(photo), "largest", photo.name), force=True)

    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for path in options.photos:
        large = read_photo(path)
        side = crop_side(fitted(large))
        for size in options.sizes:
            photo = scaled(large, size / side)
            fit = fitted(photo)
            offsets = initial_offsets(hand, fit)
            crop = crop_hand(photo, fit, offsets, config)
            own = crop_hand(photo, fit, offsets, ReconstructConfig(size=round(crop_side(fit))))

            def made(
                guess: CanonicalGaussians, fit: HandFit = fit, offsets: Tensor = offsets, crop: HandCrop = crop
            ) -> Avatar:
                adapted = adapt(hand, guess, crop, AdaptConfig(texture_steps=options.steps))
                return make_avatar(fit, offsets, crop, adapted.gaussians)

            guess = prior(crop)
            both = made(guess), made(coarsen(hand, guess, crop.rest))
            likeness = [f"{input_errors(avatar, own)['input_psnr_inner_db']:.1f}" for avatar in both]
            (far, _), (near, area) = alike(*both, FAR), alike(*both, NEAR)
            times = frame_times(list(both))
            counts = [str(len(avatar.gaussians.opacities)) for avatar in both]
            files = [f"{file_bytes(avatar) / 1e6:.1f}" for avatar in both]
            cells = [
                path.stem, str(len(own.image)), *likeness, f"{far:.1f}", f"{near:.1f}", f"{area:+.1f} %",
                *counts, *files, f"{times[1] / times[0]:.2f}",
            ]  # fmt: skip
            print(f"| {' | '.join(cells)} |", flush=True)
    most = most_seen(both[0])
    print()
    for least in LEAST:
        print(f"never above {least:.3f}: {int((most < least).sum())} of {len(most)}")


if __name__ == "__main__":
    main()
