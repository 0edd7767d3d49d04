"""How much of the estimator's error joint refinement repairs, on synthetic people that training never meets.

Poses are off as in `oasis evaluate --dataset synthetic`, by the measured errors of the estimator; landmarks are not
given to the refinement, since none go with these. Fills docs/estimator.md (refinement). With `--avatars` it also prints
PSNR of pictures in other poses, of the prior's guess and of the adapted one, when the surface is the estimated, the
refined or the true one; from photos in any light after one gain per channel.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.core.camera import project
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.types import HandCrop
from oasis_warp.estimation.refine import refine
from oasis_warp.estimation.surface_state import shape_of, state_of_surface
from oasis_warp.evaluation.held_out import (
    CaptureConfig,
    CapturedPerson,
    Lighting,
    capture_person,
    estimated_batch,
    estimator_noise,
    target_truths,
)
from oasis_warp.evaluation.methods import LitGaussians
from oasis_warp.evaluation.metrics import match_colors, score
from oasis_warp.evaluation.synthetic import crop_of, draw_targets
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import depth_map, depth_visibility
from oasis_warp.pretraining.synthetic_source import ERROR_STREAM, seeded
from oasis_warp.pretraining.training_batch import EstimatorNoise, training_batch
from studies.harness import AvatarOptions, Row, measured
from studies.inputs import iou, people, prior_named
from studies.tables import Column, Section, complete, groups, mean, percentiles, table

MARGIN = 0.0015
"""Depth by which a vertex may lie behind the nearest surface and count as visible [m]."""
MEASURES = (
    Column("visible vertices, median [px of 256]", "px", ".2f"),
    Column("the same, 90 % of a hand [px]", "px90", ".1f"),
    Column("all vertices about their mean [mm]", "mm", ".2f"),
    Column("finger joints [deg]", "degrees", ".2f"),
    Column("outline against the true one, IoU", "iou", ".3f"),
)


@dataclass(frozen=True, kw_only=True)
class Options(AvatarOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"people", "first", "errors"})
    people: int = 6
    first: int = 40
    """Number of the first of them."""
    errors: tuple[float, ...] = (1.0,)
    """Factors of the estimator's errors."""
    avatars: bool = False
    """Reconstruct, too."""


def true_crop(person: CapturedPerson, light: Lighting, capture: CaptureConfig, factor: float) -> HandCrop:
    """The true surface in the crop of the wrong mask: the same random numbers as of `estimated_batch`."""
    noise = EstimatorNoise(surface=0.0, mask=estimator_noise(factor).mask)
    random, photo = seeded(capture.seed, ERROR_STREAM, person.number), person.photos[light]
    hand = bundled_hand().to(photo.image.device)
    return crop_of(training_batch(hand, photo, person.targets[light], capture.size, random, noise))


def errors(found: HandCrop, truth: HandCrop) -> Row:
    """How far the posed surface is from the true one; keys as in `MEASURES`."""
    a, b = found.posed.vertices, truth.posed.vertices
    shift = (project(found.camera, a)[0] - project(truth.camera, b)[0]).norm(dim=1)[visible(truth)]
    return {
        "px": float(shift.median()),
        "px90": float(shift.quantile(0.9)),
        "mm": 1000 * float(((a - a.mean(0)) - (b - b.mean(0))).norm(dim=1).median()),
        "degrees": float(np.degrees(np.median(np.abs(joint_angles(found) - joint_angles(truth))))),
        "iou": iou(outline(found), outline(truth)),
    }


def visible(crop: HandCrop) -> Tensor:
    """Which vertices the photo shows."""
    vertices, camera = crop.posed.vertices, crop.camera
    faces, every = bundled_hand().faces.to(vertices.device), torch.arange(len(vertices), device=vertices.device)
    return depth_visibility(
        vertices, vertices, faces, camera.K, camera.viewmat, camera.width, camera.height, margin=MARGIN,
        point_vertices=every,
    )[0] > 0.5  # fmt: skip


def outline(crop: HandCrop) -> Tensor:
    """Pixels that the surface covers."""
    vertices, camera = crop.posed.vertices, crop.camera
    faces = bundled_hand().faces.to(vertices.device)
    seen = depth_map(vertices, faces, camera.viewmat, camera.K, camera.width, camera.height, outputs=("face_ids",))
    return seen.face_ids >= 0


def joint_angles(crop: HandCrop) -> np.ndarray:
    """The 26 angles of the model that is nearest to the surface."""
    rig = HandKinematics(bundled_hand())
    K, rest, posed = (
        part.detach().cpu().double().numpy() for part in (crop.camera.K, crop.rest.vertices, crop.posed.vertices)
    )
    return state_of_surface(rig, shape_of(rig, rest), rest, posed, K[0, 0], K[:2, 2]).state.angles


def measure(number: int, options: Options) -> Iterator[Row]:
    """Rows of one person: one for each light and factor, and with avatars one for each surface and stage, too."""
    capture, device = CaptureConfig(), torch.device(options.device)
    hand, on_device, prior = bundled_hand(), bundled_hand().to(device), prior_named(options.prior)
    person = capture_person(capture, "ordinary", number, device)
    for light in person.photos:
        exact = estimated_batch(on_device, person, light, capture, 0.0)
        truths = target_truths(exact, on_device)
        for factor in options.errors:
            batch = estimated_batch(on_device, person, light, capture, factor)
            crop, truth = crop_of(batch), true_crop(person, light, capture, factor)
            start = time.perf_counter()
            refined = refine(hand, prior(crop), crop)
            about = {"person": number, "light": light, "factor": factor}
            yield {
                **about, "before": errors(crop, truth), "after": errors(refined.crop, truth),
                "accepted": refined.accepted, "seconds": time.perf_counter() - start,
            }  # fmt: skip
            surfaces = {"estimated": crop, "refined": refined.crop, "true": truth} if options.avatars else {}
            for surface, each in surfaces.items():
                guess = prior(each)
                config = AdaptConfig(light="keep", texture_steps=options.steps)
                for stage, gaussians in (("raw", guess), ("one-shot", adapt(hand, [guess], [each], config).gaussians)):
                    images = draw_targets(LitGaussians(gaussians), on_device, batch, None)
                    psnr = [
                        score(match_colors(i, t.image, t.mask) if light == "wild" else i, t)["psnr"]
                        for i, t in zip(images, truths, strict=True)
                    ]
                    yield {**about, "surface": surface, "stage": stage, "psnr": mean(psnr)}


def run(options: Options) -> list[Row]:
    """Measure everybody."""
    cases = {f"person {k}, errors {options.errors}": (k, options) for k in people(options.people, first=options.first)}
    return measured("refinement", cases, measure, options)


def median(rows: list[Row], part: str, key: str) -> float:
    """Over people."""
    return percentiles((row[part][key] for row in rows), (50,))[0]


def table_rows(rows: list[Row]) -> list[Row]:
    """A line for each measure: estimated poses, and refined ones in each light, with the smallest errors tried."""
    rows = [row for row in complete(rows) if "before" in row]
    least = min((row["factor"] for row in rows), default=0)
    by_light = {light: own for (light,), own in groups([r for r in rows if r["factor"] == least], "light").items()}
    if "studio" not in by_light:
        return []
    lines = [
        {"measure": name, "before": format(median(by_light["studio"], "before", key), form),
         **{light: format(median(own, "after", key), form) for light, own in by_light.items()}}
        for name, key, form in MEASURES
    ]  # fmt: skip
    gain = {light: mean(r["after"]["px"] < r["before"]["px"] for r in own) for light, own in by_light.items()}
    shares = {light: f"{100 * (share or 0):.0f} %" for light, share in gain.items()}
    return [*lines, {"measure": "people whose visible vertices gain", **shares}]


def summary(rows: list[Row]) -> list[Row]:
    """Share of refinements that were taken, and seconds, for each light and factor; and PSNR."""
    found = []
    for (light, factor), own in groups([row for row in complete(rows) if "before" in row], "light", "factor").items():
        seconds = percentiles((row["seconds"] for row in own), (50,))[0]
        taken = 100 * (mean(row["accepted"] for row in own) or 0)
        found.append({"of": f"{light}, errors x {factor:g}", "found": f"{taken:.0f} % taken, {seconds:.2f} s a photo"})
    avatars = [row for row in complete(rows) if "surface" in row]
    for (light, factor, surface, stage), own in groups(avatars, "light", "factor", "surface", "stage").items():
        psnr = mean(row["psnr"] for row in own) or 0
        of = f"{light}, errors x {factor:g}, {stage} on the {surface} surface"
        found.append({"of": of, "found": f"{psnr:.2f} dB"})
    return found


SECTIONS = (
    Section("estimator.md", "refinement", table(
        (
            Column("", "measure"), Column("estimated", "before"), Column("refined, even light", "studio"),
            Column("a room", "same"), Column("any light", "wild"),
        ),
        table_rows,
    )),
    Section(None, "summary", table((Column("", "of"), Column("", "found")), summary)),
)  # fmt: skip
