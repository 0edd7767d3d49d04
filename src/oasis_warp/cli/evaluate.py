"""`oasis evaluate`: measure avatars on synthetic hands, on photos of the same hands, and by their looks."""

import sys
from collections.abc import Mapping, Sequence

import torch
from rich.table import Table

from oasis_warp.avatar.prior import MeanPrior, Prior
from oasis_warp.cli.developer_options import Evaluate
from oasis_warp.cli.progress import INTERRUPTED, Run, Step, Terminal, print_tables, show_run
from oasis_warp.cli.record import keep_command
from oasis_warp.core.config import ReconstructConfig, adapt_config
from oasis_warp.core.devices import check_device
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress
from oasis_warp.evaluation.band_energy import SIZE
from oasis_warp.evaluation.data_sets import CatalogueData, Choice, evaluate_data_set
from oasis_warp.evaluation.held_out import HELD_OUT_SEED, CaptureConfig
from oasis_warp.evaluation.kernel_distance import LAYERS
from oasis_warp.evaluation.looks import evaluate_looks
from oasis_warp.evaluation.methods import Method, method_name
from oasis_warp.evaluation.paper_tables import make_tables, pose_curve, rows_of_tables, write_tables
from oasis_warp.evaluation.pictures import write_curve
from oasis_warp.evaluation.real_hands import real_photos
from oasis_warp.evaluation.same_hand import METRICS, evaluate_photos, photos_in, photos_of_hands
from oasis_warp.evaluation.summary import (
    BLEMISHES,
    COLORS,
    GROUPS,
    HIDDEN,
    LIGHTS,
    LOOKS,
    PHOTOS,
    REGIONS,
    SYNTHETIC,
    Measure,
    Record,
    cells,
    format_number,
    kernel_cells,
    noise_rows,
    pose_name,
    select,
    with_values,
)
from oasis_warp.evaluation.synthetic import SyntheticEvaluation, evaluate_people
from oasis_warp.hand.template import bundled_hand
from oasis_warp.losses import load_lpips
from oasis_warp.network.prior import choose_prior
from oasis_warp.pretraining.synthetic_source import MULTIPLE
from oasis_warp.synthetic.shots import PICTURES_EACH

SIZES = range(64, 1025)
REAL_SECONDS, LOOKS_SECONDS, AVATAR_SECONDS, PAIR_SECONDS = 2.5, 17.0, 10.0, 0.6
"""To measure a real hand, to make an avatar and draw its looks, to make an avatar in one way, to compare a pair: of the
process with one thread, for two photos of the tests, in November 2026. Only ratios matter."""
AVATARS_PER_PHOTO = 4
"""Avatars made of each photo for pairs: without the learned prior, and with it in each of three lights."""
HIDDEN_LIGHT = "studio"
"""Light of the pictures in which hidden skin is compared: any other adds the contrast of its own shading."""
PUBLISHED = ("interhand", "hanco", "coco-hand", "whim")
TABLE_WIDTH = 120
"""Width of tables where there is no terminal, or a narrow one [characters]."""


def run(options: Evaluate) -> int:
    """Measure and print; Ctrl-C keeps what is whole.

    Raises:
        InputError: a wrong option, folder or weights file.
    """
    check_device(options.device, "--")
    check_options(options)
    priors: dict[str, Prior] = {"mean": MeanPrior(bundled_hand())}
    chosen = choose_prior(options.prior, options.backbone_weights)
    if options.prior != "none":
        priors["learned"] = chosen
    tables = dict.fromkeys(PUBLISHED, on_data_set)
    tables |= {"synthetic": on_synthetic_hands, "same-hand": on_photos, "looks": on_looks}
    try:
        with show_run(Terminal(), Run(plan(options, len(priors)))) as shown:
            made = tables[options.dataset](options, priors, shown.progress)
    except KeyboardInterrupt:
        keep_command(options.out)
        print(f"oasis: stopped; finished parts stay in {options.out}, the same command continues.", file=sys.stderr)
        return INTERRUPTED
    keep_command(options.out)
    print_tables(made, TABLE_WIDTH)
    return 0


def check_options(options: Evaluate) -> None:
    """Refuse what can be refused before anything is made.

    Raises:
        InputError: a number out of its range, or a folder too many or missing.
    """
    photos, published = options.dataset in ("same-hand", "looks"), options.dataset in PUBLISHED
    if published and (options.root is None or options.prior == "none"):
        raise InputError(f"--dataset {options.dataset}: expected --root FOLDER and a learned prior; give both.")
    for name in ("root", "mano_dir", "ablations"):
        if getattr(options, name) and not published:
            raise InputError(f"--{name.replace('_', '-')}: works only with {', '.join(PUBLISHED)}; leave it out.")
    if options.selection is not None and options.dataset != "interhand":
        raise InputError("--selection: works only with --dataset interhand; leave it out.")
    if photos and options.folder is None:
        kind = "a folder of photos" + (", or of subfolders, one per hand" if options.dataset == "same-hand" else "")
        raise InputError(f"--dataset {options.dataset}: expected {kind}; name it.")
    if not photos and options.folder is not None:
        kind = "a data set has --root" if published else "synthetic hands need no folder"
        raise InputError(f"{options.folder}: {kind}; leave it out, or use --dataset same-hand.")
    if options.dataset == "same-hand" and options.lpips is not None:
        raise InputError("--lpips: is not measured on photos of the same hand; leave it out.")
    if options.dataset == "looks" and options.size != SIZE:
        raise InputError(f"--size: looks are measured in pictures of {SIZE} pixels, got {options.size}; leave it out.")
    if options.people < 1:
        raise InputError(f"--people: expected 1 or more, got {options.people}.")
    if not 1 <= options.targets <= (options.targets if published else PICTURES_EACH):
        raise InputError(f"--targets: expected 1 to {PICTURES_EACH}, got {options.targets}; increase --people instead.")
    if options.size not in SIZES or (not photos and options.size % MULTIPLE):
        kind = "pixels" if photos else f"pixels in steps of {MULTIPLE}"
        raise InputError(f"--size: expected {SIZES[0]} to {SIZES[-1]} {kind}, got {options.size}.")
    for name in ("steps", "seed", "workers"):
        value = getattr(options, name)
        if value is not None and value < 0:
            raise InputError(f"--{name}: expected 0 or more, got {value}.")


def plan(options: Evaluate, n_priors: int) -> tuple[Step, ...]:
    """The steps of an evaluation, in seconds of one core.

    Raises:
        InputError: a folder without photos.
    """
    if options.folder is None or (options.dataset == "looks" and not options.folder.is_dir()):
        return (Step("evaluation", 1.0),)
    if options.dataset == "looks":
        return (
            Step("real hands", REAL_SECONDS * len(real_photos(options.folder))),
            Step("avatars", LOOKS_SECONDS * len(photos_in(options.folder))),
        )
    steps = []
    for name, photos in photos_of_hands(options.folder).items():
        n, n_avatars = len(photos), 1 if n_priors == 1 else AVATARS_PER_PHOTO
        avatars, pairs = AVATAR_SECONDS * n_avatars * n, PAIR_SECONDS * n * (n - 1)
        steps += [Step(f"avatars of {name}", avatars), Step(f"pairs of {name}", pairs)]
    return tuple(steps)


def on_synthetic_hands(options: Evaluate, priors: dict[str, Prior], progress: Progress) -> list[Table]:
    """A table for each group of people and light of the photo, and the curve of quality against wrong poses."""
    config = SyntheticEvaluation(
        people=options.people,
        capture=CaptureConfig(targets=options.targets, size=options.size, seed=HELD_OUT_SEED + options.seed),
        adapt=adapt_config(ReconstructConfig(steps=options.steps, seed=options.seed)),
    )
    device = torch.device(options.device)
    perceptual = None if options.lpips is None else load_lpips(*options.lpips, allow_download=options.allow_download)
    found = evaluate_people(
        priors, config, options.out, device, perceptual=perceptual, workers=options.workers, progress=progress
    )
    summary: list[Record] = found["summary"]
    tables = []
    for group in config.groups:
        for light in config.lights:
            rows = select(summary, group=group, light=light, colors=COLORS[light])
            rows = [row for row in rows if row["noise"] in config.noise]
            tables.append(make_table(f"{GROUPS[group]}, {LIGHTS[light]}", rows, SYNTHETIC))
            if (group, light) == (config.groups[0], HIDDEN_LIGHT):
                tables.append(make_table(f"Skin that the photo hides; {GROUPS[group]}, {LIGHTS[light]}", rows, HIDDEN))
    return [*tables, noise_table(summary, config)]


def noise_table(summary: Sequence[Record], config: SyntheticEvaluation) -> Table:
    """PSNR of the first group and light against how wrong the estimated poses are."""
    group, light = config.groups[0], config.lights[0]
    factors = sorted(config.noise + config.curve)
    table = Table(title=f"PSNR against wrong poses; {GROUPS[group]}, {LIGHTS[light]}")
    table.add_column("method", no_wrap=True)
    for factor in factors:
        table.add_column(pose_name(factor), justify="right")
    for method, found in noise_rows(summary, group, light, factors).items():
        table.add_row(method_name(Method(*method)), *(format_number(psnr, ".2f") for psnr in found))
    return table


def on_data_set(options: Evaluate, priors: dict[str, Prior], progress: Progress) -> list[Table]:
    """The paper's tables on a published data set, also written as files."""
    assert options.root is not None  # checked with the other options
    config = ReconstructConfig(hand_model="mano", mano_dir=options.mano_dir, device=options.device)
    data = CatalogueData.open(options.dataset, options.root, config, options.size, options.selection)
    ablated = [choose_prior(path, options.backbone_weights) for path in options.ablations]
    rows = rows_of_tables(priors, ablated, options.steps, options.seed)
    perceptual = None if options.lpips is None else load_lpips(*options.lpips, allow_download=options.allow_download)
    perceptual = perceptual and perceptual.to(options.device)
    found = evaluate_data_set(
        data, priors, rows, Choice(photos=options.people, targets=options.targets, seed=options.seed), options.out,
        config=config, perceptual=perceptual, progress=progress,
    )  # fmt: skip
    tables = make_tables(options.dataset, found["summary"])
    write_tables(options.out, tables)
    write_curve(
        options.out / "pose_errors.png", pose_curve(found["summary"]), "errors of the pose, degrees", "PSNR, dB"
    )
    n_out, shown = len(found["left_out"]), []
    for table in tables:
        shown.append(Table(title=table.title))
        for heading in table.headings:
            shown[-1].add_column(heading, justify="right" if shown[-1].columns else "left")
        for line in table.lines:
            shown[-1].add_row(*line)
    shown[0].caption = f"pictures left out: {n_out}, see {METRICS}" if n_out else None
    return shown


def on_photos(options: Evaluate, priors: dict[str, Prior], progress: Progress) -> list[Table]:
    """One table: medians over all ordered pairs."""
    assert options.folder is not None  # checked with the other options
    config = ReconstructConfig(steps=options.steps, seed=options.seed, size=options.size, device=options.device)
    found = evaluate_photos(priors, options.folder, options.out, config, progress)
    rows, n_out = found["summary"], len(found["left_out"])
    table = make_table(f"{rows[0]['pairs']} ordered pairs of photos of the same hand", rows, PHOTOS)
    if n_out:
        table.caption = f"photos left out: {n_out}, see {METRICS}"
    return [table]


def on_looks(options: Evaluate, priors: dict[str, Prior], progress: Progress) -> list[Table]:
    """Contrasts, kernel distances and blemishes."""
    assert options.folder is not None  # checked with the other options
    config = ReconstructConfig(steps=options.steps, seed=options.seed, device=options.device)
    perceptual = None if options.lpips is None else load_lpips(*options.lpips, allow_download=options.allow_download)
    prior = priors.get("learned", priors["mean"])
    found = evaluate_looks(prior, options.folder, options.out, config, perceptual=perceptual, progress=progress)
    contrast, distance, spoilt = (
        Table(title=title)
        for title in (
            f"contrast of the skin of {len(found['photos'])} avatars by size of detail, and over the yardstick's",
            "kernel distance to real hands, by resolution of the features", "blemishes, medians",
        )
    )  # fmt: skip
    shown = with_values(found["summary"]["contrast"], LOOKS) if found["summary"]["contrast"] else {}
    for heading in ("skin", *(column.heading for column in shown.values())):
        contrast.add_column(heading, justify="left" if heading == "skin" else "right", no_wrap=heading == "skin")
    for row in found["summary"]["contrast"]:
        contrast.add_row(REGIONS[row["region"]], *cells(row, shown))
    for heading in ("pictures", "all", *LAYERS):
        distance.add_column(heading, justify="left" if heading == "pictures" else "right", no_wrap=True)
    for row in found["kernel_distance"]:
        distance.add_row(row["name"], *kernel_cells(row))
    if not found["kernel_distance"]:
        distance.caption = "too few real hands in the folder"
    blemishes = with_values([found["summary"]["blemishes"]], BLEMISHES)
    for column in blemishes.values():
        spoilt.add_column(column.heading, justify="right")
    spoilt.add_row(*cells(found["summary"]["blemishes"], blemishes))
    spoilt.caption = f"photos left out: {len(found['left_out'])}, see {METRICS}" if found["left_out"] else None
    return [contrast, distance, spoilt]


def make_table(title: str, rows: Sequence[Record], columns: Mapping[str, Measure]) -> Table:
    """A line a row of a summary; the pose's errors, where there are several, in a column of their own."""
    table = Table(title=title)
    factors = {row["noise"] for row in rows if "noise" in row}
    table.add_column("method", no_wrap=True)
    if factors:
        table.add_column("pose")
    shown = with_values(rows, columns)
    for column in shown.values():
        table.add_column(column.heading, justify="right")
    for row in rows:
        pose = [pose_name(row["noise"])] if factors else []
        table.add_row(method_name(Method(row["prior"], row["stage"])), *pose, *cells(row, shown))
    if "lpips" in columns and "lpips" not in shown:
        table.caption = "LPIPS: no weights given (--lpips)"
    return table
