"""What several photos of one hand are worth: avatars of 1 to 4 photos against pictures that none of them is.

Fills docs/same_hand.md: "photos" (each photo of a hand in turn is held out, and avatars of those that follow it are
compared with it as `oasis evaluate --dataset same-hand` does), "people" (synthetic people in several poses with the
estimator's errors, against the truth in other poses and even light, colours matched) and "detail" (the fine structure
of avatars with and without Gaussians beyond 256 px). `--sheet` draws docs/_static/fusion.jpg instead.
"""

import math
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from oasis_warp.adaptation.adapt import adapt, add_detail
from oasis_warp.adaptation.reliability import observe_photos
from oasis_warp.avatar.pose import in_even_light
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.config import AdaptConfig, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandFit, HandPose, TrainingBatch
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import to_uint8
from oasis_warp.data.square_crop import resample_square, square_around
from oasis_warp.estimation.estimator import choose_hand, fit_together
from oasis_warp.estimation.hand_crop import (
    COARSE_SIZE,
    CROP_MARGIN,
    crop_hand,
    crop_hands,
    initial_surfaces,
    resolutions,
)
from oasis_warp.evaluation.held_out import HELD_OUT_SEED, POPULATIONS, estimator_noise, target_truths
from oasis_warp.evaluation.methods import LitGaussians
from oasis_warp.evaluation.metrics import TargetTruth, match_colors, score
from oasis_warp.evaluation.same_hand import compare_with_photo, draw_as_photo, photos_of_hands
from oasis_warp.evaluation.synthetic import crop_of, draw_targets
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import depth_map
from oasis_warp.pretraining.synthetic_source import ERROR_STREAM, SURROUNDINGS, seeded
from oasis_warp.pretraining.training_batch import training_batch
from oasis_warp.reconstruction import composite_over_photo, make_avatar, reconstruct, reconstruct_same_hand
from oasis_warp.synthetic.picture import SyntheticBatch, render_table
from oasis_warp.synthetic.shot_table import tabulate
from oasis_warp.synthetic.shots import PICTURES_EACH, SceneConfig, sample_shots
from studies.detail import inside_outline
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import SAME_HAND, estimator, people, prior_named
from studies.tables import Column, Section, groups, mean, table, write_jpeg

MOST = 4
"""Photos of one avatar, and targets of each synthetic person: half of a person's pictures each."""
STAGES = ("raw", "one_shot")
"""What the prior guesses, and what adaptation makes of it."""
SIGNS = {"psnr": 1, "psnr_inner": 1, "ssim_mask": 1, "ssim_quarter": 1, "overlap": 1, "error": -1}
"""Whether more of a measure is better."""
WINDOW = 9
"""What differs over more than this is light, or a surface that is a little off [px]."""
DETAILED = {
    "a1": ("a1_wood_right", ("02_flat_closed", "03_flat_closed_back", "05_c_shape_open")),
    "a3": ("a3_beige_right", ("01_victory", "02_three_fingers", "04_thumb_little")),
}
"""Folder and photos of the hands whose detail is measured; those of the first are on the sheet."""
TILE = 224
"""Side of a picture of the sheet [px]."""
FACING = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Fingers up, palm to the camera."""


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"parts", "hands", "people", "held_out", "lights", "sheet"})
    parts: tuple[Literal["photos", "people", "detail"], ...] = ("photos", "people", "detail")
    photos: Path = SAME_HAND
    """Folder with a subfolder of photos for each hand."""
    hands: tuple[str, ...] = ()
    """Names of those subfolders; all by default."""
    held_out: int = 3
    """Photos of each hand that are held out."""
    people: int = 8
    lights: tuple[Literal["studio", "wild"], ...] = ("studio", "wild")
    light: Literal["fit", "even", "keep"] = "fit"
    """What becomes of the photos' light; see `AdaptConfig`."""
    size: int = 256
    """Side of the crop [px]."""
    sheet: Path | None = None
    """JPEG to draw instead."""


# ---- synthetic people


def capture(
    number: int, size: int, light: str, device: torch.device
) -> tuple[list[TrainingBatch], list[TargetTruth]]:
    """`MOST` photos of a person as the estimator has them, with the same targets, and the truth of those.

    Which places of targets the photos show is of no use: what one photo shows would be wrong for several.
    """
    first, rendered = PICTURES_EACH * number, int(size * SURROUNDINGS)
    even = SceneConfig(population=POPULATIONS["ordinary"], look="even")
    scene = even if light == "studio" else SceneConfig(population=POPULATIONS["ordinary"])

    def shown(indices: range, scene: SceneConfig) -> SyntheticBatch:
        shots = sample_shots(HELD_OUT_SEED, indices, scene)
        table = tabulate(HELD_OUT_SEED, shots, scene)
        return render_table(HELD_OUT_SEED, table, rendered, device, scene=scene)

    targets, taken = shown(range(first, first + MOST), even), shown(range(first + MOST, first + 2 * MOST), scene)
    if light == "studio":
        taken = taken._replace(image=taken.image + 0.5 * (1 - taken.alpha[..., None]))  # a grey wall
    hand = bundled_hand().to(device)
    random = seeded(HELD_OUT_SEED, ERROR_STREAM, number)
    photos = [SyntheticBatch(*(part[k : k + 1] for part in taken)) for k in range(MOST)]
    batches = [training_batch(hand, photo, targets, size, random, estimator_noise(1.0)) for photo in photos]
    exact = training_batch(hand, photos[0], targets, size, torch.Generator(), estimator_noise(0.0))
    return batches, target_truths(exact, hand)


def measure_person(number: int, light: str, options: Options) -> Iterator[Row]:
    """Rows of avatars of each photo alone and of the first 2, 3, ..."""
    batches, truths = capture(number, options.size, light, torch.device(options.device))
    hand, prior = bundled_hand().to(options.device), prior_named(options.prior)
    crops = [crop_of(batch) for batch in batches]
    guesses, pixels = [prior(crop) for crop in crops], [float(SURROUNDINGS) for _ in batches]
    config = AdaptConfig(texture_steps=options.steps, light=options.light)
    for chosen in [(k,) for k in range(MOST)] + [tuple(range(n)) for n in range(2, MOST + 1)]:
        own, shown, scales = ([part[k] for k in chosen] for part in (guesses, crops, pixels))
        fusion = adapt(bundled_hand(), [own], [shown], config, resolutions=scales)
        seen = (fusion.observations.confidence > 0.5).any(0).float().mean()
        fused = fusion.gaussians if fusion.lights is None else in_even_light(fusion.gaussians, fusion.lights[0])
        for stage, gaussians in zip(STAGES, (fusion.guess, fused), strict=True):
            images = draw_targets(LitGaussians(gaussians), hand, batches[0], None)
            found = [score(match_colors(i, t.image, t.mask), t) for i, t in zip(images, truths, strict=True)]
            numbers = {name: mean(row[name] for row in found) for name in ("psnr", "psnr_inner", "ssim_mask")}
            yield {"who": str(number), "of": light, "stage": stage, "photos": chosen, "seen": float(seen), **numbers}


# ---- photos of real hands


def measure_hand(name: str, paths: list[Path], options: Options) -> Iterator[Row]:
    """Rows of every photo held out: avatars of each that follows it, and of the first 2, 3, ... of those."""
    config = ReconstructConfig(size=options.size, light=options.light, steps=options.steps)
    photos, alone = [], []
    for path in paths:
        try:
            photo = read_photo(path)
            alone.append(reconstruct_same_hand([photo], config, prior=prior_named(options.prior)))
            photos.append(photo)
        except InputError as error:
            print(f"left out: {error}")
    count = len(photos)
    most = min(MOST, count - 1)
    for target in range(min(options.held_out, count)):
        others = [(target + k) % count for k in range(1, most + 1)]
        made: list[tuple[tuple[int, ...], Any]] = [((k,), alone[k]) for k in others]
        for n in range(2, most + 1):
            chosen = [photos[k] for k in others[:n]]
            fused = reconstruct_same_hand(chosen, config, prior=prior_named(options.prior))
            made.append((tuple(others[:n]), fused))
        photo = photos[target]
        landmarks = choose_hand(estimator().find(photo), "largest", photo.name)
        for chosen, each in made:
            avatar: Avatar = each.avatar
            fit = estimator().fit(photo, landmarks, shape=avatar.shape.cpu(), force=True)
            crop = crop_hand(photo, fit, avatar.surface_offsets.cpu(), config)
            found = compare_with_photo(avatar, draw_as_photo(avatar, crop, fit.pose), crop, fit.pose)
            yield {
                "who": f"{name}/{photo.name}", "of": "photos", "stage": "one_shot", "photos": chosen,
                "seen": each.errors["seen_percent"] / 100, "psnr": found.psnr, "ssim_quarter": found.ssim_quarter,
                "overlap": found.overlap, "error": mean(found.region_errors.values()),
            }  # fmt: skip


# ---- detail


@torch.no_grad()
def fine_errors(
    gaussians: CanonicalGaussians, fit: HandFit, offsets: Tensor, crop: HandCrop, best: Tensor
) -> tuple[float, float]:
    """Root mean square of fine structure [1/255]: wherever the photo shows the hand, and where it is `best` [V]."""
    picture = composite_over_photo(make_avatar(fit, offsets, crop, gaussians), crop)
    difference = (picture - crop.image).permute(2, 0, 1)
    fine = (difference - avg_pool2d(difference, WINDOW, stride=1, padding=WINDOW // 2)).square().mean(0)
    faces, camera, inside = bundled_hand().faces, crop.camera, inside_outline(crop)
    seen = depth_map(crop.posed.vertices, faces, camera.viewmat, camera.K, camera.width, camera.height)
    own = best[faces[seen.face_ids.clamp_min(0).long()]].all(-1)
    return 255 * float(fine[inside].mean().sqrt()), 255 * float(fine[inside & own].mean().sqrt())


def measure_detail(name: str, paths: list[Path], options: Options) -> Iterator[Row]:
    """A row for each photo."""
    config, hand, prior = ReconstructConfig(steps=options.steps), bundled_hand(), prior_named(options.prior)
    photos = [read_photo(path) for path in paths]
    landmarks = [choose_hand(estimator().find(photo), "largest", photo.name) for photo in photos]
    fits = fit_together(estimator(), photos, landmarks)
    surfaces = initial_surfaces(bundled_hand(), fits)
    crops = crop_hands(photos, fits, surfaces, config)
    start = time.perf_counter()
    guesses = [prior(crop) for crop in crops]
    settings = AdaptConfig(texture_steps=config.steps)
    fusion = adapt(hand, guesses, crops, settings, resolutions=resolutions(fits, crops))
    fused = time.perf_counter()
    close = crop_hands(photos, fits, surfaces, config, finer=True)
    fine = add_detail(hand, fusion, close, resolutions(fits, close), COARSE_SIZE).gaussians
    ratio = (time.perf_counter() - fused) / (fused - start)
    best = observe_photos(hand, close, resolutions(fits, close)).share == 1
    for k, path in enumerate(paths):
        row: Row = {"photo": f"{name}: {path.stem}", "side": len(close[k].image), "time": ratio}
        for label, gaussians in (("without", fusion.gaussians), ("with", fine)):
            lit = gaussians._replace(colors=(gaussians.colors * fusion.gains[k]).clamp(0, 1))
            row[label], row[f"{label}_best"] = fine_errors(lit, fits[k], surfaces.own[k], close[k], best[k])
            row[f"{label}_count"] = len(gaussians.opacities)
        yield row


def detailed_photos(name: str, folder: Path) -> list[Path]:
    """The photos of a hand of `DETAILED`."""
    inner, stems = DETAILED[name]
    return [folder / inner / f"{stem}.jpg" for stem in stems]


def run(options: Options) -> list[Row]:
    """Measure, or draw the sheet."""
    if options.sheet is not None:
        draw_sheet(detailed_photos("a1", options.photos), options.config(), options.sheet)
        return []
    cases, rows = {}, []
    if "photos" in options.parts:
        hands = photos_of_hands(options.photos)
        chosen = {name: hands[name] for name in options.hands or hands}
        rows += measured("same_hand", {n: (n, p, options) for n, p in chosen.items()}, measure_hand, options)
    if "people" in options.parts:
        for light in options.lights:
            cases |= {f"person {k}, {light}": (k, light, options) for k in people(options.people)}
        rows += measured("same_hand", cases, measure_person, options)
    if "detail" in options.parts:
        detailed = {f"detail of {n}": (n, detailed_photos(n, options.photos), options) for n in DETAILED}
        rows += measured("same_hand", detailed, measure_detail, options)
    return rows


def draw_sheet(paths: list[Path], config: ReconstructConfig, sheet: Path) -> None:
    """A column for each photo and one for all together: the photo, then the open hand from palm and back."""

    def both_sides(avatar: Avatar) -> Tensor:
        mirror = torch.tensor([-1.0 if avatar.side == "left" else 1.0, 1, 1])
        orientation = mirror[:, None] * FACING * mirror
        pose = HandPose(named_pose(avatar.hand, "open"), orientation, torch.tensor([0.0, 0.0, 0.5]))
        cameras = (orbit_camera(avatar.mesh(pose).vertices, angle, size=TILE) for angle in (0.0, math.pi))
        return torch.cat([avatar.render(camera, pose).image for camera in cameras])

    photos, columns = [read_photo(path) for path in paths], []
    for photo in photos:
        made = reconstruct(photo, config)
        square = square_around(made.fit.mask, CROP_MARGIN)
        shown = resample_square(photo.rgb.float() / 255, *square, TILE).clamp(0, 1)
        columns.append(torch.cat([shown, both_sides(made.avatar)]))
    columns.append(torch.cat([torch.ones(TILE, TILE, 3), both_sides(reconstruct_same_hand(photos, config).avatar)]))
    write_jpeg(sheet, to_uint8(torch.cat(columns, 1)).numpy())


# ---- tables


def compared(rows: list[Row], measure: str) -> list[Row]:
    """One photo (mean and best of the first n) against their fusion, for every n."""
    sign, lines = SIGNS[measure], []
    for n in range(2, MOST + 1):
        found = []
        for own in groups(rows, "who").values():
            by_photos = {tuple(row["photos"]): row for row in own}
            whole = next((chosen for chosen in by_photos if len(chosen) == n), None)
            if whole is None or any(by_photos[c][measure] is None for c in (whole, *((k,) for k in whole))):
                continue
            single = [by_photos[(k,)][measure] for k in whole]
            best = max(single, key=lambda value: sign * value)
            found.append((statistics.fmean(single), best, by_photos[whole][measure], by_photos[whole]["seen"]))
        if not found:
            continue
        means, bests, fused, seen = zip(*found, strict=True)
        gains = [sign * (a - b) for a, b in zip(fused, means, strict=True)]
        lines.append({
            "n": n, "seen": statistics.fmean(seen), "mean": statistics.fmean(means), "best": statistics.fmean(bests),
            "fused": statistics.fmean(fused), "gain": statistics.fmean(gains),
            "error": statistics.stdev(gains) / len(gains) ** 0.5 if len(gains) > 1 else 0.0,
            "above_mean": mean(gain > 0 for gain in gains),
            "above_best": mean(sign * (a - b) > 0 for a, b in zip(fused, bests, strict=True)),
        })  # fmt: skip
    return lines


def section(page: str | None, marker: str, of: str, measure: str) -> Section:
    """The table of one measure, of photos or of people in one light."""
    form = ".2f" if measure.startswith("psnr") else ".3f"
    columns = (
        Column("photos", "n"), Column("surface seen", "seen", ".0%"), Column("one: mean", "mean", form),
        Column("one: best", "best", form), Column("fused", "fused", form), Column("gain", "gain", "+" + form),
        Column("±", "error", form), Column("better than mean", "above_mean", ".0%"),
        Column("than best", "above_best", ".0%"),
    )  # fmt: skip

    def chosen(rows: list[Row]) -> list[Row]:
        return [row for row in rows if (row.get("of"), row.get("stage")) == (of, "one_shot")]

    return Section(page, marker, table(columns, lambda rows: compared(chosen(rows), measure)))


SECTIONS = (
    section("same_hand.md", "photos", "photos", "psnr"),
    section(None, "photos, SSIM at a quarter", "photos", "ssim_quarter"),
    section("same_hand.md", "people", "wild", "psnr"),
    section(None, "people in even light", "studio", "psnr"),
    Section("same_hand.md", "detail", table(
        (
            Column("photo", "photo"), Column("its own side, px", "side"),
            Column("error without, /255", "without", ".1f"), Column("with, /255", "with", ".1f"),
            Column("where it is best: without, /255", "without_best", ".1f"), Column("with, /255", "with_best", ".1f"),
        ),
        lambda rows: [row for row in rows if "without" in row],
    )),
)  # fmt: skip
