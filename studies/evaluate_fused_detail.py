"""What photos of one hand give an avatar beyond 256 px: fine structure with and without finer Gaussians.

    python studies/evaluate_fused_detail.py photo.jpg another.jpg ...

Each photo is compared with the avatar in its own view, as large as its detail, away from outlines and above the wrist:
the root mean square of what differs within 9 pixels, light aside, over all it shows, and over where it is the best of
all photos, from which detail is taken. Prints the table of docs/same_hand.md.
"""

import argparse
import time
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from oasis_warp.adaptation.fuse import fuse
from oasis_warp.adaptation.reliability import look
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.core.config import AdaptConfig, ReconstructConfig
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandFit
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.fusion import crop_hands, fit_surfaces, fit_together, resolutions, with_detail
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.prior import choose_prior
from oasis_warp.ops import depth_map
from oasis_warp.reconstruction import composite_over_photo, make_avatar

RIM = 1 / 64
"""Share of the crop's side, at the outline, that is not judged."""
WINDOW = 9
"""What differs over more than this is light, or a surface that is a little off [px]."""
COLUMNS = (
    "photo",
    "its own side, px",
    "error without, /255",
    "with, /255",
    "where it is best: without, /255",
    "with, /255",
)


@torch.no_grad()
def errors(
    gaussians: CanonicalGaussians, fit: HandFit, offsets: Tensor, crop: HandCrop, gain: Tensor, best: Tensor
) -> list[float]:
    """Of fine structure [1/255]: wherever the photo shows the hand, and where it is `best` (a vertex each)."""
    lit = gaussians._replace(colors=(gaussians.colors * gain).clamp(0, 1))
    picture = composite_over_photo(make_avatar(fit, offsets, crop, lit), crop)
    apart = (picture - crop.image).permute(2, 0, 1)
    fine = (apart - avg_pool2d(apart, WINDOW, stride=1, padding=WINDOW // 2)).square().mean(0)
    faces, camera = bundled_hand().faces, crop.camera
    seen = depth_map(crop.posed.vertices, faces, camera.viewmat, camera.K, camera.width, camera.height)
    hand = crop.mask * (seen.face_ids >= 0)
    inside = inner_mask(hand, max(1, round(RIM * len(hand)))) * crop.above_wrist > 0.5
    own = best[faces[seen.face_ids.clamp_min(0).long()]].all(-1)
    return [_root_mean(fine[inside]), _root_mean(fine[inside & own])]


def _root_mean(squares: Float[Tensor, "N"]) -> float:
    return 255 * float(squares.mean().sqrt())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("--steps", type=int, help="of texture learning; stops by itself when not given")
    options = parser.parse_args()
    config, hand = ReconstructConfig(steps=options.steps), bundled_hand()
    estimator, prior = HandEstimator(hand), choose_prior("learned")
    photos = [read_photo(path) for path in options.photos]
    fits = fit_together(estimator, photos, [choose_hand(estimator.find(p), "largest", p.name) for p in photos])
    surfaces = fit_surfaces(fits)
    crops = crop_hands(photos, fits, surfaces, config)
    start = time.perf_counter()
    fusion = fuse(hand, crops, resolutions(fits, crops), prior, AdaptConfig(texture_steps=config.steps))
    fused = time.perf_counter()
    fine, close = with_detail(fusion, photos, fits, surfaces, config)
    took = (time.perf_counter() - fused) / (fused - start)
    best = look(hand, close, resolutions(fits, close)).share == 1
    lines = [f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}"]
    for k, photo in enumerate(photos):
        without, with_ = (
            errors(gaussians, fits[k], surfaces.own[k], close[k], fusion.gains[k], best[k])
            for gaussians in (fusion.gaussians, fine)
        )
        numbers = [f"{value:.1f}" for pair in zip(without, with_, strict=True) for value in pair]
        lines.append(f"| {Path(photo.name).stem} | {len(close[k].image)} | {' | '.join(numbers)} |")
    print("\n".join(lines))
    counts = [len(gaussians.opacities) for gaussians in (fusion.gaussians, fine)]
    print(f"\n{counts[0]} Gaussians without, {counts[1]} with; detail takes {took:.2f} times as long as fusion")


if __name__ == "__main__":
    main()
