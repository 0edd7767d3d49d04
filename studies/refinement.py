"""How much of the estimator's error joint refinement repairs, on synthetic people that training never meets.

Poses are off as in `oasis evaluate --dataset synthetic`, by the measured errors of the estimator; landmarks are not
given to the refinement, since none go with these. Fills docs/estimator.md (refinement).
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from oasis_warp.core.camera import project
from oasis_warp.core.types import HandCrop
from oasis_warp.estimation.refine import refine
from oasis_warp.estimation.surface_state import shape_of, state_of_surface
from oasis_warp.evaluation.held_out import (
    ERROR_STREAM,
    CaptureConfig,
    CapturedPerson,
    Lighting,
    capture_person,
    estimated_batch,
    estimator_noise,
)
from oasis_warp.evaluation.synthetic import crop_of
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.template import bundled_hand
from oasis_warp.ops import depth_map, depth_visibility
from oasis_warp.pretraining.training_batch import EstimatorNoise, training_batch
from studies.harness import Row, StudyOptions, measured
from studies.inputs import iou, people, prior_named
from studies.tables import Column, Section, complete, groups, mean, percent, percentiles, table

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
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"people", "first"})
    prior: str = "learned"
    """learned, or a weights file."""
    people: int = 6
    first: int = 40
    """Number of the first of them."""


def true_crop(person: CapturedPerson, light: Lighting, capture: CaptureConfig) -> HandCrop:
    """The true surface in the crop of the wrong mask: the same random numbers as of `estimated_batch`."""
    (state,) = np.random.SeedSequence([capture.seed, ERROR_STREAM, person.number]).generate_state(1)
    noise = EstimatorNoise(surface=0.0, mask=estimator_noise(1.0).mask)
    random, photo = torch.Generator().manual_seed(int(state)), person.photos[light]
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
    """A row for each light on one person."""
    capture, device = CaptureConfig(), torch.device(options.device)
    hand, prior = bundled_hand(), prior_named(options.prior)
    person = capture_person(capture, "ordinary", number, device)
    for light in person.photos:
        crop = crop_of(estimated_batch(hand.to(device), person, light, capture, 1.0))
        truth, start = true_crop(person, light, capture), time.perf_counter()
        refined = refine(hand, prior(crop), crop)
        yield {
            "light": light, "seconds": time.perf_counter() - start, "taken": refined.accepted,
            "before": errors(crop, truth), "after": errors(refined.crop, truth),
        }  # fmt: skip


def run(options: Options) -> list[Row]:
    """Measure everybody."""
    cases = {f"person {k}": (k, options) for k in people(options.people, first=options.first)}
    return measured("refinement", cases, measure, options)


def lines(rows: list[Row]) -> list[Row]:
    """A line for each measure: estimated poses, and refined ones in each light."""
    by_light = {light: own for (light,), own in groups(complete(rows), "light").items()}
    if "studio" not in by_light:
        return []

    def line(name: str, words: Callable[[list[Row]], str]) -> Row:
        return {"measure": name, **{light: words(own) for light, own in by_light.items()}}

    def median(own: list[Row], part: str, column: Column) -> str:
        return column.text(percentiles((row[part][column.value] for row in own), (50,))[0])

    return [
        *(line(each.heading, lambda own, each=each: median(own, "after", each))
          | {"before": median(by_light["studio"], "before", each)} for each in MEASURES),
        line("people whose visible vertices gain",
             lambda own: percent(mean(row["after"]["px"] < row["before"]["px"] for row in own) or 0)),
        line("refinements that are taken", lambda own: percent(mean(row["taken"] for row in own) or 0)),
        line("seconds", lambda own: f"{percentiles((row['seconds'] for row in own), (50,))[0]:.1f}"),
    ]  # fmt: skip


COLUMNS = (
    Column("", "measure"), Column("estimated", "before"), Column("refined, even light", "studio"),
    Column("a room", "same"), Column("any light", "wild"),
)  # fmt: skip
SECTIONS = (Section("estimator.md", "refinement", table(COLUMNS, lines)),)
