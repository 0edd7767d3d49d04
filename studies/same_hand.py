"""What several photos of one hand are worth: avatars of 1 to 4 photos against pictures that none of them is.

Fills docs/same_hand.md: "photos" (each photo of a hand in turn is held out, and avatars of those that follow it are
compared with it as `oasis evaluate --dataset same-hand` does) and "detail" (the fine structure of avatars with and
without Gaussians beyond 256 px).
"""

import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from oasis_warp.adaptation.adapt import adapt, add_detail
from oasis_warp.adaptation.reliability import observe_photos
from oasis_warp.avatar.observation import inner_mask
from oasis_warp.avatar.quality import over_photo
from oasis_warp.core.config import adapt_config
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import CanonicalGaussians, HandCrop, HandFit
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import choose_hand, fit_together
from oasis_warp.estimation.hand_crop import (
    COARSE_SIZE,
    crop_hand,
    crop_hands,
    initial_surfaces,
    refine_surfaces,
    resolutions,
)
from oasis_warp.evaluation.same_hand import compare_with_photo, photos_of_hands
from oasis_warp.fitted_avatar import draw_as_photo, make_avatar
from oasis_warp.hand.template import bundled_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops import depth_map
from oasis_warp.reconstruction import reconstruct_same_hand
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import SAME_HAND, estimator, prior_named
from studies.tables import Column, Section, groups, table

MOST = 4
"""Photos of one avatar."""
RIM = 1 / 64
"""Share of the crop's side, at the outline, that is not judged."""
WINDOW = 9
"""What differs over more than this is light, or a surface that is a little off [px]."""
DETAILED = {
    "a1": ("a1_wood_right", ("02_flat_closed", "03_flat_closed_back", "05_c_shape_open")),
    "a3": ("a3_beige_right", ("01_victory", "02_three_fingers", "04_thumb_little")),
}
"""Folder and photos of the hands whose detail is measured."""


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"parts", "hands", "held_out"})
    parts: tuple[Literal["photos", "detail"], ...] = ("photos", "detail")
    photos: Path = SAME_HAND
    """Folder with a subfolder of photos for each hand."""
    hands: tuple[str, ...] = ()
    """Names of those subfolders; all by default."""
    held_out: int = 3
    """Photos of each hand that are held out."""


# ---- photos of real hands


def measure_hand(name: str, paths: list[Path], options: Options) -> Iterator[Row]:
    """Rows of every photo held out: avatars of each that follows it, and of the first 2, 3, ... of those."""
    config = options.config()
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
                "who": f"{name}/{photo.name}", "photos": chosen, "seen": each.errors["seen_percent"] / 100,
                "psnr": found.psnr, "ssim_quarter": found.ssim_quarter,
            }  # fmt: skip


# ---- detail


def inside_outline(crop: HandCrop) -> Tensor:
    """Pixels away from the outlines of mask and surface and above the wrist.

    Between fingers that touch in the photo the surface may have a gap, which no Gaussian fills.
    """
    camera, faces = crop.camera, bundled_hand().faces
    seen = depth_map(crop.posed.vertices, faces, camera.viewmat, camera.K, camera.width, camera.height)
    hand = crop.mask * (seen.face_ids >= 0)
    return inner_mask(hand, max(1, round(RIM * len(hand)))) * crop.above_wrist > 0.5


@torch.no_grad()
def fine_errors(
    gaussians: CanonicalGaussians, fit: HandFit, offsets: Tensor, crop: HandCrop, best: Tensor
) -> tuple[float, float]:
    """Root mean square of fine structure [1/255]: wherever the photo shows the hand, and where it is `best` [V]."""
    picture = over_photo(draw_as_photo(make_avatar(fit, offsets, crop, gaussians), crop, fit.pose), crop)
    difference = (picture - crop.image).permute(2, 0, 1)
    fine = (difference - avg_pool2d(difference, WINDOW, stride=1, padding=WINDOW // 2)).square().mean(0)
    faces, camera, inside = bundled_hand().faces, crop.camera, inside_outline(crop)
    seen = depth_map(crop.posed.vertices, faces, camera.viewmat, camera.K, camera.width, camera.height)
    own = best[faces[seen.face_ids.clamp_min(0).long()]].all(-1)
    return 255 * float(fine[inside].mean().sqrt()), 255 * float(fine[inside & own].mean().sqrt())


def measure_detail(name: str, options: Options) -> Iterator[Row]:
    """A row for each photo of a hand of `DETAILED`."""
    folder, stems = DETAILED[name]
    paths = [options.photos / folder / f"{stem}.jpg" for stem in stems]
    config, hand, prior = options.config(), bundled_hand(), prior_named(options.prior)
    photos = [read_photo(path) for path in paths]
    landmarks = [choose_hand(estimator().find(photo), "largest", photo.name) for photo in photos]
    fits = fit_together(estimator(), photos, landmarks)
    surfaces = initial_surfaces(hand, fits)
    crops = crop_hands(photos, fits, surfaces, config)
    guesses = [prior(crop) for crop in crops]
    surfaces = refine_surfaces(hand, photos, fits, surfaces, guesses, config)
    crops, start = crop_hands(photos, fits, surfaces, config), time.perf_counter()
    settings = adapt_config(config)
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


def run(options: Options) -> list[Row]:
    """Measure what is asked for."""
    rows = []
    if "photos" in options.parts:
        hands = photos_of_hands(options.photos)
        cases = {name: (name, hands[name], options) for name in options.hands or hands}
        rows += measured("same_hand", cases, measure_hand, options)
    if "detail" in options.parts:
        cases = {f"detail of {name}": (name, options) for name in DETAILED}
        rows += measured("same_hand", cases, measure_detail, options)
    return rows


# ---- tables


def compared(rows: list[Row], measure: str) -> list[Row]:
    """One photo (mean and best of the first n) against their fusion, for every n."""
    lines = []
    for n in range(2, MOST + 1):
        found = []
        for own in groups([row for row in rows if "who" in row], "who").values():
            by_photos = {tuple(row["photos"]): row for row in own}
            for whole in (chosen for chosen in by_photos if len(chosen) == n):
                single = [by_photos[(k,)][measure] for k in whole]
                fused = by_photos[whole]
                found.append((statistics.fmean(single), max(single), fused[measure], fused["seen"]))
        if not found:
            continue
        means, bests, fused, seen = (np.array(each) for each in zip(*found, strict=True))
        gains = fused - means
        lines.append({
            "n": n, "seen": seen.mean(), "mean": means.mean(), "best": bests.mean(), "fused": fused.mean(),
            "gain": gains.mean(), "error": gains.std(ddof=1) / len(gains) ** 0.5 if len(gains) > 1 else 0.0,
            "above_mean": (gains > 0).mean(), "above_best": (fused > bests).mean(),
        })  # fmt: skip
    return lines


def section(page: str | None, marker: str, measure: str, form: str) -> Section:
    """The table of one measure."""
    columns = (
        Column("photos", "n"), Column("surface seen", "seen", ".0%"), Column("one: mean", "mean", form),
        Column("one: best", "best", form), Column("fused", "fused", form), Column("gain", "gain", "+" + form),
        Column("±", "error", form), Column("better than mean", "above_mean", ".0%"),
        Column("than best", "above_best", ".0%"),
    )  # fmt: skip
    return Section(page, marker, table(columns, lambda rows: compared(rows, measure)))


SECTIONS = (
    section("same_hand.md", "photos", "psnr", ".2f"),
    section(None, "photos, SSIM at a quarter", "ssim_quarter", ".3f"),
    Section("same_hand.md", "detail", table(
        (
            Column("photo", "photo"), Column("its own side, px", "side"),
            Column("error without, /255", "without", ".1f"), Column("with, /255", "with", ".1f"),
            Column("where it is best: without, /255", "without_best", ".1f"), Column("with, /255", "with_best", ".1f"),
        ),
        lambda rows: [row for row in rows if "without" in row],
    )),
)  # fmt: skip
