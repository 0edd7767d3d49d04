"""Evaluate the prior and one-shot adaptation on synthetic people that training never meets.

This module needs only the core of the package, so a script on a machine with CUDA can call `evaluate_people`.
"""

import copyreg
import functools
import io
import json
import pickle
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp import __version__
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import Prior
from oasis_warp.avatar.vertex_light import rotate_light, with_photo
from oasis_warp.core.camera import camera_center
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.processes import single_threaded_math, worker_pool
from oasis_warp.core.types import Camera, HandCrop, PosedHand, TrainingBatch
from oasis_warp.data.output_files import open_resumable_folder, write_file
from oasis_warp.evaluation.held_out import (
    FIRST_PERSON,
    CaptureConfig,
    Group,
    Lighting,
    capture_person,
    estimated_batch,
    target_truths,
)
from oasis_warp.evaluation.methods import METHODS, LitGaussians, Method, method_name, prior_digest, reconstructions
from oasis_warp.evaluation.metrics import TargetTruth, match_colors, score
from oasis_warp.evaluation.pictures import ATTENTION_COLUMNS, tile, write_attention, write_sheet, write_strip
from oasis_warp.evaluation.summary import Record, read_result, summarise
from oasis_warp.hand.template import bundled_hand
from oasis_warp.losses import Lpips, Perceptual
from oasis_warp.render import render

SETTINGS, METRICS, SHEET, ATTENTION, PEOPLE = (
    "evaluation.json", "metrics.json", "sheet.png", "attention.png", "people"
)  # fmt: skip
"""Files that an evaluation writes; the last is a folder with the results of each person."""
SHOWN = 4
"""People of each group on the sheet, and hands on the picture of attention."""
DIGITS = 5
"""Digits of the numbers in files."""
KEYS = ("group", "person", "light", "noise", "prior", "stage", "target", "colors", "psnr")
"""Keys of every record."""


@dataclass(frozen=True, kw_only=True)
class SyntheticEvaluation:
    """Options of an evaluation."""

    groups: tuple[Group, ...] = ("ordinary", "tattoo", "ring")
    people: int = 16
    """Number of people in each group."""
    lights: tuple[Lighting, ...] = ("same", "studio", "wild")
    noise: tuple[float, ...] = (0.0, 1.0)
    """Factors of the estimator's errors, for every group; 0 is the true pose."""
    curve: tuple[float, ...] = (0.5, 2.0, 4.0)
    """Further factors, for the first group and light only."""
    methods: tuple[Method, ...] = METHODS
    """Methods whose prior is not given are left out."""
    capture: CaptureConfig = field(default_factory=CaptureConfig)
    adapt: AdaptConfig = field(default_factory=AdaptConfig)


def evaluate_people(
    priors: Mapping[str, Prior],
    config: SyntheticEvaluation,
    folder: Path,
    device: torch.device,
    *,
    perceptual: Lpips | None = None,
    workers: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure every method on every person, write numbers and pictures, and return the contents of METRICS.

    An interrupted run goes on with the people that are missing.

    Args:
        priors: By the names of methods' priors.
        config: What to measure.
        folder: Output folder.
        device: Device to compute on.
        perceptual: LPIPS, if its weights are available.
        workers: Processes that measure people in parallel after the first one; 0 for none. One process leaves a GPU
            idle most of the time.
        progress: Called for each person.

    Raises:
        InputError: the folder cannot be used, or holds an evaluation with other settings.
    """
    settings = {
        "version": __version__,
        "priors": {name: prior_digest(prior) for name, prior in priors.items()},
        "lpips": perceptual is not None,
        **asdict(config),
    }
    settings = json.loads(json.dumps(settings))  # tuples become lists, as a file has them
    open_resumable_folder(folder, SETTINGS, settings, "an evaluation")
    (folder / PEOPLE).mkdir(exist_ok=True)
    everybody = [(group, FIRST_PERSON + k) for group in config.groups for k in range(config.people)]
    missing = [who for who in everybody if _kept(folder, *who) is None]
    measured = _measured(_Setup(priors, config, perceptual), folder, missing, device, workers)
    for done in range(len(everybody) - len(missing), len(everybody)):
        progress("evaluation", done, len(everybody))
        next(measured)
    progress("evaluation", len(everybody), len(everybody))
    records = [record for who in everybody for record in json.loads(_person_file(folder, *who).read_bytes())]
    strips = [
        path for group in config.groups for k in range(min(SHOWN, config.people))
        if (path := _person_file(folder, group, FIRST_PERSON + k).with_suffix(".png")).exists()
    ]  # fmt: skip
    write_sheet(folder / SHEET, strips, ["photo", "truth", *map(method_name, available_methods(priors, config))])
    maps = sorted((folder / PEOPLE).glob("*_attention.png"))
    if maps:
        write_sheet(folder / ATTENTION, maps, ATTENTION_COLUMNS)
    found = {"settings": settings, "summary": summarise(records), "pictures": records}
    write_file(folder / METRICS, json.dumps(found, allow_nan=False).encode())
    return found


def _person_file(folder: Path, group: Group, number: int) -> Path:
    return folder / PEOPLE / f"{group}_{number}.json"


def _kept(folder: Path, group: Group, number: int) -> list[Record] | None:
    """The records of one person, where they have been measured."""
    file = _person_file(folder, group, number)
    strips = [path for path in (file.with_suffix(".png"), _attention_file(file, number)) if path.exists()]
    return read_result(file, KEYS, strips)


def _attention_file(file: Path, number: int) -> Path:
    return file.with_name(f"{number}_attention.png")


def available_methods(priors: Mapping[str, Prior], config: SyntheticEvaluation) -> list[Method]:
    """Methods of `config` whose prior is given, grouped by prior."""
    return [method for name in priors for method in config.methods if method.prior == name]


class _Setup(NamedTuple):
    """What every person is measured with, in this process or another."""

    priors: Mapping[str, Prior]
    config: SyntheticEvaluation
    perceptual: Lpips | None


def _measured(
    setup: _Setup, folder: Path, missing: Sequence[tuple[Group, int]], device: torch.device, workers: int
) -> Iterator[None]:
    """Measure one person per step."""
    first = 1 if workers else len(missing)  # kernels are compiled once, and not by every process
    packed = _packed(setup) if workers else b""
    for who in missing[:first]:
        yield measure_person(setup, folder, device, *who)
    rest = missing[first:]
    if not rest:
        return
    with worker_pool(min(workers, len(rest))) as pool:
        try:
            waiting = [pool.submit(_measure_in_worker, packed, folder, device, *who) for who in rest]
            for done in as_completed(waiting):
                yield done.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)  # or all others would still be measured
            raise


def _packed(setup: _Setup) -> bytes:
    """Pickled as a whole: single tensors would pass through shared memory, and containers have little of it."""
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer)
    pickler.dispatch_table = {**copyreg.dispatch_table, MappingProxyType: lambda proxy: (dict, (dict(proxy),))}
    pickler.dump(setup)
    return buffer.getvalue()


@functools.lru_cache(1)
def _unpacked(packed: bytes) -> _Setup:
    return pickle.loads(packed)


def _measure_in_worker(packed: bytes, folder: Path, device: torch.device, group: Group, number: int) -> None:
    """`measure_person` in another process, which unpacks the setup once."""
    measure_person(_unpacked(packed), folder, device, group, number)


@single_threaded_math()
def measure_person(setup: _Setup, folder: Path, device: torch.device, group: Group, number: int) -> None:
    """Write pictures of the first few people, then the records of one person."""
    config, hand, file = setup.config, bundled_hand().to(device), _person_file(folder, group, number)
    perceptual = setup.perceptual.to(device) if setup.perceptual else None
    person = capture_person(config.capture, group, number, device)
    records, rows, shown = [], [], number < FIRST_PERSON + SHOWN
    for light in config.lights:
        exact = estimated_batch(hand, person, light, config.capture, 0.0)
        truths = target_truths(exact, hand)
        curve = config.curve if (group, light) == (config.groups[0], config.lights[0]) else ()
        for factor in config.noise + curve:
            batch = estimated_batch(hand, person, light, config.capture, factor)
            row = [tile(batch.image[0]), tile(truths[0].image)]
            for method, images in draw_methods(setup, hand, batch, person.light_rotations[light]):
                about = {"group": group, "person": number, "light": light, "noise": factor}
                records += [{**about, **method._asdict(), **found} for found in score_all(images, truths, perceptual)]
                row.append(tile(images[0]))
            if factor == config.noise[-1]:
                rows.append(row)
        if shown and (group, light) == (config.groups[0], config.lights[0]):
            write_attention(_attention_file(file, number), setup.priors, crop_of(exact))
    if shown:
        write_strip(file.with_suffix(".png"), rows)
    write_file(file, json.dumps(records, allow_nan=False).encode())


def draw_methods(
    setup: _Setup, hand: HandModel, batch: TrainingBatch, rotations: Float[Tensor, "T 3 3"] | None
) -> Iterator[tuple[Method, list[Tensor]]]:
    """The result of each method from the one photo of `batch`, drawn in the pose and view of each target."""
    methods = available_methods(setup.priors, setup.config)
    for method, made in reconstructions(bundled_hand(), crop_of(batch), setup.priors, methods, setup.config.adapt):
        yield method, draw_targets(made, hand, batch, rotations)


def draw_targets(
    made: LitGaussians, hand: HandModel, batch: TrainingBatch, rotations: Float[Tensor, "T 3 3"] | None
) -> list[Float[Tensor, "H H 3"]]:
    """Draw Gaussians made of the one photo of `batch` in the pose and view of each target, over black.

    The photo's light falls on targets after `rotations` (`CapturedPerson.light_rotations`); without, light is even.
    """
    rest, size = batch.rest[0], batch.target_images.shape[2]
    images = []
    for k, (posed, viewmat, K) in enumerate(
        zip(batch.target_posed[0], batch.target_viewmats[0], batch.target_Ks[0], strict=True)
    ):
        if made.light is None or rotations is None:
            posed_gaussians = pose_gaussians(made.without_light(), hand.faces, rest, posed)
        else:
            turn = rotations[k].to(rest)
            photo, seen_from = batch.posed[0] @ turn.T, turn @ camera_center(batch.viewmat[0])
            light = with_photo(rotate_light(made.light, turn), rest, photo, hand.faces, seen_from)
            posed_gaussians = pose_gaussians(made.gaussians, hand.faces, rest, posed, light, camera_center(viewmat))
        images.append(render(posed_gaussians, Camera(viewmat, K, size, size)).image)
    return images


def score_all(images: list[Tensor], truths: list[TargetTruth], perceptual: Perceptual | None) -> Iterator[Record]:
    """Two records for each target: as drawn, and with colours matched to it."""
    for k, (image, truth) in enumerate(zip(images, truths, strict=True)):
        for colors in ("raw", "matched"):
            judged = match_colors(image, truth.image, truth.mask) if colors == "matched" else image
            found = score(judged, truth, perceptual)
            numbers = {name: None if value is None else round(value, DIGITS) for name, value in found.items()}
            yield {"target": k, "colors": colors, **numbers}


def crop_of(batch: TrainingBatch) -> HandCrop:
    """The one photo of `batch` as input of priors and adaptation."""
    size = batch.image.shape[1]
    unknown = [batch.rest.new_full((n, 3), float("nan")) for n in (16, 5)]  # joints and tips, which are not used
    return HandCrop(
        image=batch.image[0],
        mask=batch.mask[0],
        above_wrist=torch.ones_like(batch.mask[0]),
        camera=Camera(batch.viewmat[0], batch.K[0], size, size),
        rest=PosedHand(batch.rest[0], *unknown),
        posed=PosedHand(batch.posed[0], *unknown),
    )
