"""What of that which a photo shows of a hand is found again on other photos of it: the constants of sh_lighting.

    python studies/measure_persistence.py tests/data/photos/same_hand --jobs 2

An avatar is made of every photo; what it learned beyond the prior's guess is compared, vertex by vertex, with what the
avatars of the other photos of the hand did. Prints two tables: the gain, which is the share that is found again, by the
angle that the skin has turned and by the way along the skin over which it changes; and how colours of one photo differ
from the guess, along the line of light and shadow and across it.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise, permutations
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from oasis_warp.adaptation.adapt import adapt, remove_photo_light
from oasis_warp.adaptation.inpainting import inpaint
from oasis_warp.adaptation.sh_lighting import DARK, MOST, marks
from oasis_warp.avatar.anchors import vertex_colors
from oasis_warp.avatar.observation import observe
from oasis_warp.avatar.pose import with_shade_baked
from oasis_warp.core.config import AdaptConfig, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.evaluation.same_hand import photos_of_hands
from oasis_warp.hand.template import bundled_hand
from oasis_warp.network.prior import choose_prior
from oasis_warp.reconstruction import crop_hand, initial_offsets

ANGLES = (0, 15, 30, 45, 70, 180)
"""Between which the skin has turned [degrees]."""
WAYS = (0.016, 0.008, 0.004, 0.002)
"""Over which what is seen changes [m]."""
SHOWN = 0.3
"""Confidence from which a photo shows a vertex."""
QUANTILES = (0.5, 0.9, 0.98, 0.99, 0.999)


class Beyond(NamedTuple):
    """What one photo shows beyond the guess."""

    differences: Tensor
    """Of the logarithms of colours, by ways along the skin, from the longest on: [5, V, 3]."""
    confidence: Tensor
    facing: Tensor


def read_hand(paths: list[Path]) -> list[Beyond]:
    """Of every photo of one hand."""
    torch.set_num_threads(1)
    hand, prior, config, settings = bundled_hand(), choose_prior("learned"), ReconstructConfig(size=256), AdaptConfig()
    estimator, found = HandEstimator(hand), []
    for path in paths:
        photo = read_photo(path)
        try:
            fit = estimator.fit(photo, choose_hand(estimator.find(photo), "largest", photo.name))
        except InputError as error:
            print(f"left out: {error}")
            continue
        crop = crop_hand(photo, fit, initial_offsets(hand, fit), config)
        with torch.no_grad():
            guess = prior(crop)
            sure, light = remove_photo_light(hand, guess, crop, settings)
        made = adapt(hand, guess, crop, settings)
        assert light is not None and light.facing is not None
        learned = vertex_colors(with_shade_baked(made.gaussians), len(hand.template))
        guessed = vertex_colors(guess._replace(colors=made.calibration.apply(guess.colors)), len(hand.template))
        whole = (learned.clamp_min(DARK) / guessed.clamp_min(DARK)).log().clamp(-MOST, MOST)
        confidence = observe(hand, sure).confidence
        smooth = [inpaint(crop.rest.vertices, hand.faces, whole, confidence, way) for way in WAYS]
        parts = [smooth[0], *(fine - coarse for coarse, fine in pairwise(smooth)), whole - smooth[-1]]
        found.append(Beyond(torch.stack(parts), confidence, light.facing))
    return found


def gains(hands: list[list[Beyond]]) -> str:
    """The first table."""
    sums = torch.zeros(2, len(ANGLES) - 1, len(WAYS) + 1)
    for photos in hands:
        for one, other in permutations(photos, 2):
            both = (one.confidence > SHOWN) & (other.confidence > SHOWN)
            angle = (one.facing * other.facing).sum(-1).clamp(-1, 1).arccos().rad2deg()
            for k, (least, most) in enumerate(pairwise(ANGLES)):
                there = both & (angle >= least) & (angle < most)
                weight = (one.confidence * other.confidence)[there, None]
                a, b = one.differences[:, there], other.differences[:, there]
                sums[0, k] += (weight * a * b).sum((1, 2))
                sums[1, k] += (weight * a * a).sum((1, 2))
    ways = [f"{1000 * way:g} mm" for way in WAYS]
    names = [f"over {ways[0]}", *(f"{long} to {short}" for long, short in pairwise(ways)), f"under {ways[-1]}"]
    lines = [f"| turned by | {' | '.join(names)} |", "| --- " * (len(names) + 1) + "|"]
    for (least, most), row in zip(pairwise(ANGLES), sums[0] / sums[1], strict=True):
        lines.append(f"| {least} to {most}° | {' | '.join(f'{float(gain):.2f}' for gain in row)} |")
    return "\n".join(lines)


def line_of_light(hands: list[list[Beyond]]) -> str:
    """The directions, and the second table."""
    whole = torch.cat([photo.differences.sum(0)[photo.confidence > SHOWN] for photos in hands for photo in photos])
    spread, axes = torch.linalg.eigh(whole.T @ whole / len(whole))
    across = whole @ (axes[:, :2] / spread[:2].sqrt())
    measures = {"across, standard deviations": across.norm(dim=1), "brighter, mean logarithm": whole.mean(1)}
    rows = [[f"{q:.1%}" for q in QUANTILES]]
    for values in measures.values():
        ordered = values.sort()[0]
        rows.append([f"{float(ordered[int(q * (len(ordered) - 1))]):.2f}" for q in QUANTILES])
    names = [f"of {len(whole)} vertices, below", *measures]
    lines = [f"| {name} | {' | '.join(row)} |" for name, row in zip(names, rows, strict=True)]
    lines.insert(1, "| --- " * (len(QUANTILES) + 1) + "|")
    said = ["standard deviations of differences of logarithms, and directions over them, across and along:"]
    for deviation, direction in zip(spread.sqrt().tolist(), axes.T.tolist(), strict=True):
        said.append(f"  {deviation:.3f}: {', '.join(f'{x / deviation:.1f}' for x in direction)}")
    said.append(f"taken for marks: {float(marks(whole).mean()):.1%}")
    return "\n".join([*said, "", *lines])


def main() -> None:
    """Read the command line, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, help="a folder of photos for each hand")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    folders = list(photos_of_hands(options.photos).values())
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as processes:
        hands = list(processes.map(read_hand, folders))
    print(gains(hands), line_of_light(hands), sep="\n\n")


if __name__ == "__main__":
    main()
