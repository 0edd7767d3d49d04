"""Evaluate the prior and one-shot adaptation on synthetic people that were never met.

Nothing here needs more than the package's core: a script on a machine with CUDA can call `evaluate`.
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
from oasis_warp.avatar.anchors import faces_of_vertices
from oasis_warp.avatar.observation import input_of_batch
from oasis_warp.avatar.pose import pose_gaussians, turn_light
from oasis_warp.avatar.prior import Prior
from oasis_warp.core import surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.processes import worker_pool
from oasis_warp.core.types import Camera, HandCrop, PosedHand, TrainingBatch
from oasis_warp.data.output_files import open_resumable_folder, write_file
from oasis_warp.evaluation.held_out import (
    FIRST_PERSON,
    Group,
    Lighting,
    Shoot,
    as_estimated,
    photograph,
    true_targets,
)
from oasis_warp.evaluation.methods import METHODS, Made, Method, label, prior_digest, reconstructions
from oasis_warp.evaluation.metrics import Truth, match_colors, score
from oasis_warp.evaluation.pictures import (
    ATTENTION_COLUMNS,
    draw_attention,
    has_attention,
    tile,
    write_sheet,
    write_strip,
)
from oasis_warp.evaluation.summary import Record, summarise
from oasis_warp.hand.template import bundled_hand
from oasis_warp.losses.lpips import Lpips
from oasis_warp.network.prior import NetworkPrior
from oasis_warp.pretraining.objective import Perceptual
from oasis_warp.render.render import render

SETTINGS, METRICS, SHEET, ATTENTION, PEOPLE = (
    "evaluation.json", "metrics.json", "sheet.png", "attention.png", "people"
)  # fmt: skip
"""What an evaluation leaves in its folder; the last is a folder of what was found of each person."""
SHOWN = 4
"""People of each group on the sheet, and hands on the picture of attention."""
DIGITS = 5
"""Of the numbers in files."""


@dataclass(frozen=True, kw_only=True)
class SyntheticEvaluation:
    """What is asked, of whom, and how."""

    groups: tuple[Group, ...] = ("ordinary", "tattoo", "ring")
    people: int = 16
    """In each group."""
    lights: tuple[Lighting, ...] = ("same", "studio", "wild")
    noise: tuple[float, ...] = (0.0, 1.0)
    """Times the estimator's errors, for every group; 0 is the true pose."""
    curve: tuple[float, ...] = (0.5, 2.0, 4.0)
    """More of them, for the first group and light only."""
    methods: tuple[Method, ...] = METHODS
    """Those whose prior is not given are left out."""
    shoot: Shoot = field(default_factory=Shoot)
    adapt: AdaptConfig = field(default_factory=AdaptConfig)


def evaluate(
    priors: Mapping[str, Prior],
    config: SyntheticEvaluation,
    folder: Path,
    device: torch.device,
    *,
    perceptual: Lpips | None = None,
    workers: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure every method on every person, and leave numbers and pictures in `folder`; what METRICS then holds.

    A run that was stopped goes on with the people that are missing.

    Args:
        priors: By the names that methods have for them; see `methods.usual_priors`.
        config: What to measure.
        folder: Where files go; its parent must exist.
        device: Where to compute.
        perceptual: LPIPS, where its weights are at hand.
        workers: Processes that measure people side by side, once the first has been measured; 0 for none. Most of the
            time a GPU waits for one.
        progress: Told of people as they are measured.

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
    missing = [who for who in everybody if not _place(folder, *who).exists()]
    measured = _measured(_Bench(priors, config, perceptual), folder, missing, device, workers)
    for done in range(len(everybody) - len(missing), len(everybody)):
        progress("evaluation", done, len(everybody))
        next(measured)
    progress("evaluation", len(everybody), len(everybody))
    records = [record for who in everybody for record in json.loads(_place(folder, *who).read_text())]
    strips = [
        path for group in config.groups for k in range(min(SHOWN, config.people))
        if (path := _place(folder, group, FIRST_PERSON + k).with_suffix(".png")).exists()
    ]  # fmt: skip
    write_sheet(folder / SHEET, strips, ["photo", "truth", *map(label, asked_methods(priors, config))])
    maps = sorted((folder / PEOPLE).glob("*_attention.png"))
    if maps:
        write_sheet(folder / ATTENTION, maps, ATTENTION_COLUMNS)
    found = {"settings": settings, "summary": summarise(records), "pictures": records}
    write_file(folder / METRICS, json.dumps(found, allow_nan=False).encode())
    return found


def _place(folder: Path, group: Group, number: int) -> Path:
    return folder / PEOPLE / f"{group}_{number}.json"


def asked_methods(priors: Mapping[str, Prior], config: SyntheticEvaluation) -> list[Method]:
    """Those of `config` whose prior is there, a prior after the other."""
    return [method for name in priors for method in config.methods if method.prior == name]


class _Bench(NamedTuple):
    """What every person is measured with, wherever that is done."""

    priors: Mapping[str, Prior]
    config: SyntheticEvaluation
    perceptual: Lpips | None


def _measured(
    bench: _Bench, folder: Path, missing: Sequence[tuple[Group, int]], device: torch.device, workers: int
) -> Iterator[None]:
    """Measure everybody, one a step."""
    here = 1 if workers else len(missing)  # kernels are compiled once, and not by every process
    packed = _packed(bench) if workers else b""
    for who in missing[:here]:
        yield measure(bench, folder, device, *who)
    there = missing[here:]
    if not there:
        return
    with worker_pool(min(workers, len(there))) as pool:
        try:
            waiting = [pool.submit(_measure_there, packed, folder, device, *who) for who in there]
            for done in as_completed(waiting):
                yield done.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)  # or all others would still be measured
            raise


def _packed(bench: _Bench) -> bytes:
    """As a whole: tensors one by one would go through shared memory, of which containers have little."""
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer)
    pickler.dispatch_table = {**copyreg.dispatch_table, MappingProxyType: lambda proxy: (dict, (dict(proxy),))}
    pickler.dump(bench)
    return buffer.getvalue()


@functools.lru_cache(1)
def _unpacked(packed: bytes) -> _Bench:
    return pickle.loads(packed)


def _measure_there(packed: bytes, folder: Path, device: torch.device, group: Group, number: int) -> None:
    """`measure` in another process, which unpacks the bench once."""
    measure(_unpacked(packed), folder, device, group, number)


def measure(bench: _Bench, folder: Path, device: torch.device, group: Group, number: int) -> None:
    """Write the records of one person, and pictures of the first few; the records last."""
    config, hand, place = bench.config, bundled_hand().to(device), _place(folder, group, number)
    perceptual = bench.perceptual.to(device) if bench.perceptual else None
    vertex_faces = faces_of_vertices(hand.faces, len(hand.template))
    session = photograph(config.shoot, group, number, device)
    records, rows, shown = [], [], number < FIRST_PERSON + SHOWN
    for light in config.lights:
        exact = as_estimated(hand, session, light, config.shoot, 0.0)
        truths = true_targets(exact, hand, vertex_faces)
        curve = config.curve if (group, light) == (config.groups[0], config.lights[0]) else ()
        for factor in config.noise + curve:
            batch = as_estimated(hand, session, light, config.shoot, factor)
            row = [tile(batch.image[0]), tile(truths[0].image)]
            for method, images in draw(bench, hand, batch, session.turns[light]):
                about = {"group": group, "person": number, "light": light, "noise": factor}
                records += [{**about, **method._asdict(), **found} for found in score_all(images, truths, perceptual)]
                row.append(tile(images[0]))
            if factor == config.noise[-1]:
                rows.append(row)
        if shown and (group, light) == (config.groups[0], config.lights[0]):
            write_attention(place.with_name(f"{number}_attention.png"), bench.priors, exact)
    if shown:
        write_strip(place.with_suffix(".png"), rows)
    write_file(place, json.dumps(records, allow_nan=False).encode())


def draw(
    bench: _Bench, hand: HandModel, batch: TrainingBatch, turns: Float[Tensor, "T 3 3"] | None
) -> Iterator[tuple[Method, list[Tensor]]]:
    """What each method makes of the one photo of `batch`, drawn as each target shows it."""
    methods = asked_methods(bench.priors, bench.config)
    for method, made in reconstructions(
        bundled_hand(), crop_of(batch), bench.priors, methods, bench.config.adapt
    ):
        yield method, draw_targets(made, hand, batch, turns)


def draw_targets(
    made: Made, hand: HandModel, batch: TrainingBatch, turns: Float[Tensor, "T 3 3"] | None
) -> list[Float[Tensor, "H H 3"]]:
    """What was made of the one photo of `batch` as each target shows it, over black.

    `turns` says how the photo's light falls on targets (`Session.turns`); without, it does not.
    """
    rest, size = batch.rest[0], batch.target_images.shape[2]
    normals, images = surface.vertex_normals(rest, hand.faces), []
    for k, (posed, viewmat, K) in enumerate(
        zip(batch.target_posed[0], batch.target_viewmats[0], batch.target_Ks[0], strict=True)
    ):
        if made.light is None or turns is None:
            there = pose_gaussians(made.without_light(), hand.faces, rest, posed)
        else:
            light = turn_light(made.light, turns[k].to(normals)), normals
            there = pose_gaussians(made.gaussians, hand.faces, rest, posed, light)
        images.append(render(there, Camera(viewmat, K, size, size)).image)
    return images


def score_all(images: list[Tensor], truths: list[Truth], perceptual: Perceptual | None) -> Iterator[Record]:
    """Two records a target: as drawn, and with the colours matched to it."""
    for k, (image, truth) in enumerate(zip(images, truths, strict=True)):
        for colors in ("raw", "matched"):
            judged = match_colors(image, truth.image, truth.mask) if colors == "matched" else image
            found = score(judged, truth, perceptual)
            numbers = {name: None if value is None else round(value, DIGITS) for name, value in found.items()}
            yield {"target": k, "colors": colors, **numbers}


def write_attention(path: Path, priors: Mapping[str, Prior], batch: TrainingBatch) -> None:
    """Write where the learned prior looks, if its network has such attention."""
    prior = priors.get("learned")
    if isinstance(prior, NetworkPrior) and has_attention(prior.network):
        write_strip(path, [draw_attention(prior.network.to(batch.image.device), input_of_batch(batch))])


def crop_of(batch: TrainingBatch) -> HandCrop:
    """The one photo of `batch` as what priors and adaptation look at."""
    size = batch.image.shape[1]
    unknown = [batch.rest.new_full((n, 3), float("nan")) for n in (16, 5)]  # joints and tips: nobody asks for them
    return HandCrop(
        image=batch.image[0],
        mask=batch.mask[0],
        above_wrist=torch.ones_like(batch.mask[0]),
        camera=Camera(batch.viewmat[0], batch.K[0], size, size),
        rest=PosedHand(batch.rest[0], *unknown),
        posed=PosedHand(batch.posed[0], *unknown),
    )
