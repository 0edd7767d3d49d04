"""What several photos of one hand are worth: avatars of 1, 2, 3 and 4 photos against pictures that none of them is.

    python studies/evaluate_fusion.py synthetic out/fusion --people 6 --device cuda
    python studies/evaluate_fusion.py same-hand out/fusion --photos tests/data/photos/same_hand

`synthetic`: people that no training has met, photographed in several poses from several sides with the estimator's
errors, against the truth in other poses and views in even light. `same-hand`: a folder of photos for each hand; each
in turn is held out, avatars are made of the ones that follow it, and compared as `oasis evaluate --dataset same-hand`
does.
Colours are matched to the target. Prints the tables of docs/same_hand.md and leaves every number in synthetic.json and
same_hand.json.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from oasis_warp.adaptation.fuse import fuse
from oasis_warp.avatar.anchors import faces_of_vertices
from oasis_warp.avatar.pose import in_even_light, pose_gaussians
from oasis_warp.avatar.prior import Prior
from oasis_warp.core.config import AdaptConfig, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Camera, CanonicalGaussians, Landmarks, Photo, TrainingBatch
from oasis_warp.data.output_files import write_file
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.evaluation.held_out import (
    FIRST_PERSON,
    HELD_OUT_SEED,
    POPULATIONS,
    estimator_noise,
    true_targets,
)
from oasis_warp.evaluation.metrics import Truth, match_colors, score
from oasis_warp.evaluation.photo_pairs import compare_with_photo, draw_as_photo
from oasis_warp.evaluation.same_hand import photos_of_hands
from oasis_warp.evaluation.synthetic import crop_of
from oasis_warp.fusion import crop_hands, fit_surfaces, fit_together, resolutions, settle_surfaces, with_detail
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.network.prior import choose_prior
from oasis_warp.pretraining.synthetic_source import ERROR_STREAM, SURROUNDINGS
from oasis_warp.pretraining.training_batch import training_batch
from oasis_warp.reconstruction import crop_hand, make_avatar
from oasis_warp.render.render import render
from oasis_warp.synthetic.picture import SyntheticBatch, render_planned
from oasis_warp.synthetic.shot_table import tabulate
from oasis_warp.synthetic.shots import PICTURES_EACH, SceneConfig, sample_shots

MOST = 4
"""Photos of one avatar, and targets of each synthetic person: half of a person's pictures each."""
STAGES = ("raw", "one_shot")
"""What the prior guesses, and what adaptation makes of it."""
Row = dict[str, Any]


# ---- synthetic people


def photograph(number: int, size: int, look: str, device: torch.device) -> tuple[list[TrainingBatch], list[Truth]]:
    """`MOST` photos of a person as the estimator has them, all with the same targets, and the targets' truth.

    What photos show of the targets is not asked: those of one photo only would be wrong for several.
    """
    first, rendered = PICTURES_EACH * number, int(size * SURROUNDINGS)
    even = SceneConfig(population=POPULATIONS["ordinary"], look="even")
    scenery = even if look == "studio" else SceneConfig(population=POPULATIONS["ordinary"])

    def shown(indices: range, scenery: SceneConfig) -> SyntheticBatch:
        shots = sample_shots(HELD_OUT_SEED, indices, scenery)
        table = tabulate(HELD_OUT_SEED, shots, scenery)
        return render_planned(HELD_OUT_SEED, table, rendered, device, scenery=scenery)

    targets, taken = shown(range(first, first + MOST), even), shown(range(first + MOST, first + 2 * MOST), scenery)
    if look == "studio":
        taken = taken._replace(image=taken.image + 0.5 * (1 - taken.alpha[..., None]))  # a grey wall
    hand = bundled_hand().to(device)
    (state,) = np.random.SeedSequence([HELD_OUT_SEED, ERROR_STREAM, number]).generate_state(1)
    random = torch.Generator().manual_seed(int(state))
    batches = []
    for k in range(MOST):
        photo = SyntheticBatch(*(part[k : k + 1] for part in taken))
        batches.append(training_batch(hand, photo, targets, size, random, estimator_noise(1.0)))
    exact = training_batch(
        hand, SyntheticBatch(*(part[:1] for part in taken)), targets, size, torch.Generator(), estimator_noise(0.0)
    )
    return batches, true_targets(exact, hand, faces_of_vertices(hand.faces, len(hand.template)))


def draw(gaussians: CanonicalGaussians, batch: TrainingBatch) -> list[torch.Tensor]:
    """The targets, over black."""
    faces, size = bundled_hand().faces.to(batch.rest.device), batch.target_images.shape[2]
    drawn = []
    for posed, viewmat, K in zip(batch.target_posed[0], batch.target_viewmats[0], batch.target_Ks[0], strict=True):
        there = pose_gaussians(gaussians, faces, batch.rest[0], posed)
        drawn.append(render(there, Camera(viewmat, K, size, size)).image)
    return drawn


def measure_person(number: int, look: str, prior: Prior, options: argparse.Namespace) -> Iterator[Row]:
    """Rows of avatars of each photo alone and of the first 2, 3, ..."""
    batches, truths = photograph(number, options.size, look, torch.device(options.device))
    crops = [crop_of(batch) for batch in batches]
    guesses, pixels = [prior(crop) for crop in crops], [float(SURROUNDINGS) for _ in batches]
    config = AdaptConfig(texture_steps=options.steps, light=options.light)
    for chosen in [(k,) for k in range(MOST)] + [tuple(range(n)) for n in range(2, MOST + 1)]:
        shown = ([part[k] for k in chosen] for part in (crops, pixels, guesses))
        fusion = fuse(bundled_hand(), *shown, config)
        seen = (fusion.sightings.confidence > 0.5).any(0).float().mean()
        fused = fusion.gaussians if fusion.lights is None else in_even_light(fusion.gaussians, fusion.lights[0])
        for stage, gaussians in zip(STAGES, (fusion.guess, fused), strict=True):
            found = [
                score(match_colors(image, truth.image, truth.mask), truth)
                for image, truth in zip(draw(gaussians, batches[0]), truths, strict=True)
            ]
            numbers = {name: _mean(row[name] for row in found) for name in ("psnr", "psnr_inner", "ssim_mask")}
            yield {"who": number, "light": look, "photos": chosen, "stage": stage, "seen": float(seen), **numbers}


# ---- photos of real hands


def avatar_of(
    estimator: HandEstimator,
    pairs: list[tuple[Photo, Landmarks]],
    prior: Prior,
    config: ReconstructConfig,
    adapt: AdaptConfig,
) -> tuple[Avatar, float]:
    """As `reconstruct_same_hand`, from landmarks that are known; and the share of vertices that are seen."""
    photos, landmarks = zip(*pairs, strict=True)
    fits = fit_together(estimator, photos, landmarks)
    surfaces = fit_surfaces(fits)
    crops = crop_hands(photos, fits, surfaces, config)
    guesses = [prior(crop) for crop in crops]
    surfaces = settle_surfaces(photos, fits, surfaces, guesses, config)
    crops = crop_hands(photos, fits, surfaces, config)
    fusion = fuse(estimator.hand, crops, resolutions(fits, crops), guesses, adapt)
    seen = float((fusion.sightings.confidence > 0.5).any(0).float().mean())
    gaussians, _ = with_detail(fusion, photos, fits, surfaces, config)
    light = fusion.lights[0] if fusion.lights else None
    return make_avatar(fits[0], surfaces.shared, crops[0], gaussians, light), seen


def measure_hand(name: str, paths: list[Path], prior: Prior, options: argparse.Namespace) -> Iterator[Row]:
    """Rows of every photo held out: avatars of each that follows it, and of the first 2, 3, ... of those."""
    estimator, config = HandEstimator(bundled_hand()), ReconstructConfig(size=options.size, light=options.light)
    adapt = AdaptConfig(texture_steps=options.steps, light=options.light)
    pairs, alone = [], []
    for path in paths:
        try:
            photo = read_photo(path)
            pair = photo, choose_hand(estimator.find(photo), "largest", photo.name)
            alone.append(avatar_of(estimator, [pair], prior, config, adapt))
            pairs.append(pair)
        except InputError as error:
            print(f"left out: {error}", file=sys.stderr)
    count = len(pairs)
    most, held_out = min(MOST, count - 1), min(options.held_out or count, count)
    for target in range(held_out):
        others = [(target + k) % count for k in range(1, most + 1)]
        made = [((k,), alone[k]) for k in others]
        made += [
            (tuple(others[:n]), avatar_of(estimator, [pairs[k] for k in others[:n]], prior, config, adapt))
            for n in range(2, most + 1)
        ]
        photo, landmarks = pairs[target]
        for chosen, (avatar, seen) in made:
            fit = estimator.fit(photo, landmarks, shape=avatar.shape.cpu(), force=True)
            crop = crop_hand(photo, fit, avatar.surface_offsets.cpu(), config)
            found = compare_with_photo(avatar, draw_as_photo(avatar, crop, fit.pose), crop, fit.pose)
            yield {
                "who": f"{name}/{photo.name}", "photos": chosen, "stage": "one_shot", "seen": seen,
                "psnr": found.psnr, "ssim_quarter": found.ssim_quarter, "overlap": found.overlap,
                "error": _mean(found.region_errors.values()),
            }  # fmt: skip


# ---- tables


def _mean(values: Any) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def tabulate_rows(rows: list[Row], measure: str, *, better: int = 1) -> str:
    """One photo (mean and best of the first n) against their fusion, for every n; in Markdown."""
    lines = ["| photos | surface seen | one: mean | one: best | fused | gain | ± | better than mean | than best |"]
    lines.append("| --- " * 9 + "|")
    for n in range(2, MOST + 1):
        means, bests, fused, seen = [], [], [], []
        for who in dict.fromkeys(row["who"] for row in rows):
            own = {tuple(row["photos"]): row for row in rows if row["who"] == who}
            whole = next((chosen for chosen in own if len(chosen) == n), None)
            if whole is None or any(own[chosen][measure] is None for chosen in [whole, *((k,) for k in whole)]):
                continue
            single = [own[(k,)][measure] for k in whole]
            means.append(statistics.fmean(single))
            bests.append(max(single, key=lambda value: better * value))
            fused.append(own[whole][measure])
            seen.append(own[whole]["seen"])
        if not fused:
            continue
        gains = [better * (a - b) for a, b in zip(fused, means, strict=True)]
        error = statistics.stdev(gains) / len(gains) ** 0.5 if len(gains) > 1 else 0.0
        above = [sum(better * (a - b) > 0 for a, b in zip(fused, other, strict=True)) for other in (means, bests)]
        digits = 2 if measure.startswith("psnr") else 3
        numbers = [f"{statistics.fmean(part):.{digits}f}" for part in (means, bests, fused)]
        share = [f"{100 * count / len(fused):.0f}%" for count in above]
        lines.append(
            f"| {n} | {100 * statistics.fmean(seen):.0f}% | {' | '.join(numbers)} | "
            f"{statistics.fmean(gains):+.{digits}f} | {error:.{digits}f} | {share[0]} | {share[1]} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", choices=("synthetic", "same-hand"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--photos", type=Path, default=Path("tests/data/photos/same_hand"))
    parser.add_argument("--hands", nargs="*", help="names of the folders in --photos; all when not given")
    parser.add_argument("--held-out", type=int, help="photos of each hand that are held out; all when not given")
    parser.add_argument("--people", type=int, default=6)
    parser.add_argument("--lights", nargs="*", default=["studio", "wild"])
    parser.add_argument("--prior", default="learned", help="learned, none or a weights file")
    parser.add_argument("--light", default="fit", choices=("fit", "even", "keep"), help="see AdaptConfig")
    parser.add_argument("--steps", type=int, help="of texture learning; stops by itself when not given")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--device", default="cpu", help="for synthetic people")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    prior = choose_prior(options.prior if options.prior in ("learned", "none") else Path(options.prior))
    rows: list[Row] = []
    if options.dataset == "synthetic":
        for number in range(FIRST_PERSON, FIRST_PERSON + options.people):
            for look in options.lights:
                rows += measure_person(number, look, prior, options)
                print(f"person {number}, {look}", file=sys.stderr, flush=True)
        tables = {
            f"{look}, {stage}, {measure}": tabulate_rows(
                [row for row in rows if (row["light"], row["stage"]) == (look, stage)], measure
            )
            for look in options.lights
            for stage in STAGES
            for measure in ("psnr", "psnr_inner")
        }
    else:
        for name, paths in photos_of_hands(options.photos).items():
            if options.hands and name not in options.hands:
                continue
            rows += measure_hand(name, paths, prior, options)
            print(name, file=sys.stderr, flush=True)
        signs = {"psnr": 1, "ssim_quarter": 1, "overlap": 1, "error": -1}
        tables = {measure: tabulate_rows(rows, measure, better=sign) for measure, sign in signs.items()}
    place = options.out / f"{options.dataset.replace('-', '_')}.json"
    write_file(place, json.dumps({"tables": tables, "rows": rows}, indent=1).encode())
    for title, table in tables.items():
        print(f"{title}\n\n{table}\n")


if __name__ == "__main__":
    main()
