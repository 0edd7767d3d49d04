"""Synthetic people that training never meets, photographed for evaluation, with the errors of the estimator."""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.avatar.observation import observe_batch, source_photos
from oasis_warp.core import surface
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.surface import faces_of_vertices
from oasis_warp.core.types import TrainingBatch
from oasis_warp.evaluation.metrics import TargetTruth
from oasis_warp.evaluation.views import clear_of_outlines
from oasis_warp.ops import depth_map
from oasis_warp.pretraining.prior_trainer import true_pictures
from oasis_warp.pretraining.synthetic_source import ERROR_STREAM, SURROUNDINGS, seeded
from oasis_warp.pretraining.training_batch import EstimatorNoise, training_batch
from oasis_warp.synthetic.picture import SyntheticBatch, render_capture, render_table, slice_batch
from oasis_warp.synthetic.shots import (
    EVERYBODY,
    PICTURES_EACH,
    SceneConfig,
    Shot,
    ShotTable,
    camera_rotation,
    capture_shots,
    sample_shots,
    tabulate,
)
from oasis_warp.synthetic.view_and_light import diffuse_light, sample_light
from oasis_warp.synthetic.wardrobe import sample_clothes

Group = Literal["ordinary", "tattoo", "ring"]
"""Kinds of people: the same bodies and photos, with a tattoo or a ring added."""
Lighting = Literal["studio", "same", "wild"]
"""Light of photo and targets. "same": both of one capture, with the soft light, colours and exposure of a room and a
cheap camera; "studio": both in even light, the photo before a plain wall; "wild": the photo in any light, hard shadows
included, targets in even light."""

_BARE = replace(EVERYBODY, tattoo=0.0, ring=0.0)
POPULATIONS = {"ordinary": _BARE, "tattoo": replace(_BARE, tattoo=1.0), "ring": replace(_BARE, ring=1.0)}
HELD_OUT_SEED, FIRST_PERSON = 20_261_121, 1_000_000
"""Seed of the world and number of the first person, both out of the reach of training."""
WALL_STREAM = 5
"""Stream of the random numbers of walls."""
DIRECTED = 0.25
"""Share of a capture's light that keeps its direction. With all of it the evaluation would test relighting alone: a
side that is lit in the photo and dark in a target, or vice versa, would hide all else."""
STRETCH = 1.25
"""Area of a face in the pose over that at rest from which skin counts as stretched (a twentieth of what is shown); the
inverse for squeezed skin (another twentieth)."""


@dataclass(frozen=True, kw_only=True)
class CaptureConfig:
    """How people are photographed."""

    targets: int = 4
    """Pictures of each hand in other poses and views, at most `PICTURES_EACH`."""
    size: int = 256
    """Side of photos and targets [px], a multiple of 16."""
    seed: int = HELD_OUT_SEED
    """Seed of people, pictures and the estimator's errors."""


class CapturedPerson(NamedTuple):
    """The pictures of one person."""

    number: int
    photos: dict[Lighting, SyntheticBatch]
    """All in the same pose and view."""
    targets: dict[Lighting, SyntheticBatch]
    """All in the same poses and views; "studio" and "wild" share them."""
    light_rotations: dict[Lighting, Float[Tensor, "T 3 3"] | None]
    """Rotations of the light from the photo's frame to that of each target; None where targets have another light.
    All hands are rendered as right ones, so they hold for left hands mirrored."""


def capture_person(capture: CaptureConfig, group: Group, number: int, device: torch.device) -> CapturedPerson:
    """Render the photos and targets of person `number`."""
    seed, size, first = capture.seed, int(capture.size * SURROUNDINGS), PICTURES_EACH * number
    any_light = SceneConfig(population=POPULATIONS[group])
    even = replace(any_light, look="even")
    (photo,) = sample_shots(seed, [first], any_light)
    goals = sample_shots(seed, range(first, first + capture.targets), even)

    def planned(shots: list[Shot]) -> ShotTable:
        return tabulate(seed, shots, any_light)

    plain = render_table(seed, planned([_evenly_lit(photo), *goals]), size, device, scene=even)
    studio, even_goals = slice_batch(plain, slice(1)), slice_batch(plain, slice(1, None))
    wall = torch.tensor(np.random.default_rng([seed, WALL_STREAM, number]).uniform(0.1, 0.9, 3)).to(studio.image)
    studio = studio._replace(image=studio.image + (1 - studio.alpha[..., None]) * wall)
    soft = photo._replace(light=diffuse_light(photo.light, DIRECTED))
    same, same_goals = render_capture(
        seed, planned([soft]), planned(capture_shots(seed, soft, goals)), size, device, scene=any_light
    )
    rotations = torch.from_numpy(np.stack([camera_rotation(seed, goal.index) for goal in goals])).float()
    return CapturedPerson(
        number,
        {"studio": studio, "same": same, "wild": render_table(seed, planned([photo]), size, device, scene=any_light)},
        {"studio": even_goals, "same": same_goals, "wild": even_goals},
        {"studio": torch.eye(3).expand(capture.targets, 3, 3), "same": rotations, "wild": None},
    )


def _evenly_lit(shot: Shot) -> Shot:
    rng = np.random.default_rng([shot.seed])
    clothes = sample_clothes(rng, bare=True)
    return shot._replace(light=sample_light(rng, "even"), clothes=clothes, room=None, sensor=None)


def estimator_noise(factor: float) -> EstimatorNoise:
    """Errors of pose, shape and camera `factor` times as large as the estimator's, none with 0.

    Errors of the mask are scaled up to 1 only: they cannot be doubled.
    """
    return EstimatorNoise(surface=factor, mask=min(factor, 1.0))


def estimated_batch(
    hand: HandModel, person: CapturedPerson, light: Lighting, capture: CaptureConfig, factor: float
) -> TrainingBatch:
    """One photo and its targets as training sees them, with `estimator_noise` of the same direction for any factor.

    Errors affect where the photo is read. Targets are drawn on the true surface, since the outline of a wrong one would
    outweigh all else.
    """
    random = seeded(capture.seed, ERROR_STREAM, person.number)
    return training_batch(
        hand, person.photos[light], person.targets[light], capture.size, random, estimator_noise(factor)
    )


def target_truths(batch: TrainingBatch, hand: HandModel) -> list[TargetTruth]:
    """The true targets of the one hand of `batch`, which has the photo's true pose; `hand` is on its device."""
    vertex_faces = faces_of_vertices(hand.faces, len(hand.template))
    pictures = true_pictures(batch, hand.faces, hand.rim)
    size, vertices = batch.target_images.shape[2], batch.target_posed[0]
    seen = depth_map(vertices, hand.faces, batch.target_viewmats[0], batch.target_Ks[0], size, size, validate=False)
    every_vertex = torch.arange(len(hand.template), device=vertices.device)
    visible = observe_batch(source_photos(batch), hand.faces, vertex_faces, every_vertex).visibility[0]
    at_rest = _face_areas(batch.rest[0], hand.faces)
    truths = []
    for k, (image, mask) in enumerate(zip(*pictures, strict=True)):
        face = seen.face_ids[k].clamp_min(0).long()
        shown = (visible[hand.faces[face]] * seen.barycentrics[k]).sum(-1)
        ratio = (_face_areas(vertices[k], hand.faces) / at_rest)[face]
        on_hand = seen.face_ids[k] >= 0
        truths.append(
            TargetTruth(
                image,
                mask,
                batch.target_known[0, k],
                on_hand & (shown < 0.5),
                on_hand & (ratio > STRETCH),
                on_hand & (ratio < 1 / STRETCH),
                on_hand & clear_of_outlines(seen.depth[k]),
            )
        )
    return truths


def _face_areas(vertices: Tensor, faces: Tensor) -> Tensor:
    return surface.face_normals(vertices, faces)[1].clamp_min(1e-12)
