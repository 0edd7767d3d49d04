"""How fast a data set of 10,000 photos is read, and its pictures loaded for training by so many processes.

Fills docs/datasets.md (loading). The tree is that of the tests in HanCo's format, with a hand in MANO's.
"""

import itertools
import os
import shutil
import tarfile
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch
from tests.datasets.trees import hanco
from tests.mano_files import write_mano

from oasis_warp.core.errors import InputError
from oasis_warp.datasets.readers import read_dataset
from oasis_warp.datasets.training_source import AHEAD, DatasetHands
from oasis_warp.hand.mano import read_mano
from oasis_warp.hand.template import bundled_hand
from studies.harness import Row, StudyOptions, measured
from studies.tables import Column, Section, table

HANDS, VIEWS, SIZE = 8, 4, 256
"""Photos of a batch, targets of each, and their side [px]: those of the paper's profile in docs/network.md."""
TRAINED = 181
"""Pictures a second that its training takes with LPIPS on one H200: 40 in 220 ms, by the table there."""
PARTS = ("rgb", "mask_hand", "calib", "shape")


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"kinds"})
    photos: int = 10_016
    """Photos of the tree; a multiple of the 32 that are drawn."""
    processes: tuple[int, ...] = (0, 1, 2)
    """Processes that load; 0 is a thread of the training."""
    kinds: tuple[Literal["files", "tar"], ...] = ("files", "tar")
    """As single files or in one tar file."""
    seconds: float = 10.0
    """To load for, each time."""


def write_tree(root: Path, photos: int, packed: bool) -> Path:
    """A tree in HanCo's format, sequences of 16 photos linked again and again; the folder of its MANO files."""
    mano = write_mano(root / "mano")
    drawn = len(hanco(root, {side: read_mano(mano, side) for side in ("right", "left")}))
    for part, copy in itertools.product(PARTS, range(1, photos // drawn)):
        for k, sequence in enumerate(("0003", "0154")):
            shutil.copytree(root / part / sequence, root / part / f"{1000 + 2 * copy + k}", copy_function=os.link)
    if packed:
        with tarfile.open(root / "all.tar", "w", dereference=True) as archive:
            for part in PARTS:
                archive.add(root / part, part)
        for part in PARTS:
            shutil.rmtree(root / part)
    return mano


def measure_readers(kind: str, photos: int, processes: tuple[int, ...], seconds: float) -> list[Row]:
    """A row for each number of processes."""
    rows, size = [], HANDS * (1 + VIEWS)
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        mano, start = write_tree(root, photos, kind == "tar"), time.perf_counter()
        catalogue = read_dataset("hanco", root, mano)
        read = time.perf_counter() - start
        for n in processes:
            hands = DatasetHands(
                catalogue=catalogue, models={side: read_mano(mano, side) for side in ("right", "left")},
                hand=bundled_hand(), seed=0, hands=HANDS, views=VIEWS, size=SIZE, device=torch.device("cpu"), workers=n,
            )  # fmt: skip
            batches, load = hands.loaded(0, 0, 1), os.getloadavg()[0]
            for _ in range(1 + AHEAD * n):  # processes have started, and what they had ahead is gone
                next(batches)
            start, done = time.perf_counter(), 0
            while (passed := time.perf_counter() - start) < seconds:
                next(batches)
                done += 1
            batches.close()
            rows.append({
                "kind": kind, "processes": n, "samples": len(catalogue.samples), "read_s": read, "load": load,
                "errors": len(catalogue.left_out) + len(hands.failed), "a_second": done * size / passed,
            })  # fmt: skip
    return rows


def run(options: Options) -> list[Row]:
    """Both kinds of trees.

    Raises:
        InputError: photos that are no multiple of those drawn.
    """
    if options.photos % 32:
        raise InputError(f"--photos: expected a multiple of 32, got {options.photos}.")
    about = options.photos, options.processes, options.seconds
    return measured("data_loading", {kind: (kind, *about) for kind in options.kinds}, measure_readers, options)


SECTIONS = (
    Section("datasets.md", "loading", table((
        Column("tree", "kind"), Column("photos", "samples", ",d"), Column("s to read it", "read_s", ".1f"),
        Column("processes that load", "processes"), Column("pictures a second", "a_second", ".0f"),
        Column("times a training", lambda row: row["a_second"] / TRAINED, ".1f"), Column("errors", "errors"),
        Column("load before", "load", ".1f"),
    ))),
)  # fmt: skip
