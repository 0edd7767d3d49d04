"""One worker of `oasis batch`: photos in; for each a folder and a line of JSON out.

    OUT/avatars/ab/abcdef...   results of a photo, named by SHA-256 of photo, settings and version: avatar.safetensors,
                               report.json and row.json, or row.json alone where the photo was refused
    OUT/rows/TASK.jsonl        a line for each photo of a finished task
    OUT/tries/abcdef...        photos in work, with a byte each time they were begun

A folder is written beside its place and renamed, and one that is there is kept. So a task may be cut off anywhere, be
repeated, or run twice at once: no photo is lost, none is there twice, and none is half there.
"""

import functools
import hashlib
import json
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import torch

from oasis_warp import __version__
from oasis_warp.avatar.prior import Prior
from oasis_warp.cli.reconstruct import write_results
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.devices import check_device
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import timed_stage
from oasis_warp.core.types import Photo
from oasis_warp.data.output_files import make_folders, new_folder, write_file
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.networks import networks
from oasis_warp.estimation.segmentation import check_opencv
from oasis_warp.network.prior import choose_prior
from oasis_warp.ops import warm_up
from oasis_warp.reconstruction import reconstruct

Row = dict[str, Any]
AVATARS, ROWS, TRIES, ROW = "avatars", "rows", "tries", "row.json"
MAX_TRIES = 3
"""Times that a photo may end its process, by the memory it takes or a fault in a library, until it is left out."""
COUNTS = ("made", "refused", "failed", "kept")
MEASURES = ("reprojection_percent", "mask_iou", "input_psnr_db", "seen_percent")


@dataclass(frozen=True, kw_only=True)
class Order:
    """Input, output and settings of a run; the same for all of its tasks."""

    source: Path
    """Folder that the names of photos are relative to, absolute."""
    out: Path
    """Absolute."""
    config: ReconstructConfig
    pictures: bool = False
    """Write summary.png, quality.png and turntable.mp4 too."""
    version: str = __version__

    @functools.cached_property
    def settings(self) -> dict[str, Any]:
        """All that results depend on but the photo, as JSON values; networks by what is in their files."""
        about = dict(_prior(self.config.prior, self.config.backbone_weights).about)
        if "sha256" in about:
            about.pop("name")
        config = asdict(replace(self.config, prior="none", backbone_weights=None, mano_dir=None))
        return {**config, "prior": about, "pictures": self.pictures, "version": self.version}

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the settings."""
        return hashlib.sha256(json.dumps(self.settings, sort_keys=True).encode()).hexdigest()

    def folder(self, key: str) -> Path:
        """Where the results of the photo with this key lie; 256 folders share them, as in git."""
        return self.out / AVATARS / key[:2] / key

    def rows_file(self, names: Iterable[str]) -> Path:
        """The lines of a task."""
        text = json.dumps([self.digest, str(self.source), *names])
        return self.out / ROWS / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.jsonl"


def make_avatars(
    names: Iterable[str], order: Order, tell: Callable[[Mapping[str, int]], object] = lambda counts: None
) -> dict[str, int]:
    """Make avatars of photos, one after the other; how many were made, refused, failed, and kept from before.

    Args:
        names: Names of the photos' files, relative to `order.source`; also an array of them, as Ray gives.
        order: What to make of them.
        tell: Called with the counts so far after each photo.

    Raises:
        InputError: this process cannot make any: another version, no such device, a damaged installation, a full disk.
    """
    names = [str(name) for name in names]
    prepare(order)
    file, counts = order.rows_file(names), Counter[str](dict.fromkeys(COUNTS, 0))
    before, rows = {row["photo"]: row for row in read_rows(file)}, []
    for name in names:
        row, kept = _row(name, order, before.get(name))
        rows.append(json.dumps(row) + "\n")
        counts["kept" if kept else row["status"]] += 1
        tell(counts)
    write_file(file, "".join(rows).encode())
    return dict(counts)


def read_rows(file: Path) -> list[Row]:
    """The lines of a task that was finished before; none of one that was not."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []


def prepare(order: Order) -> None:
    """Load what all photos need, once in a process, which from then on uses one thread.

    Raises:
        InputError: this process cannot make avatars.
    """
    if order.version != __version__:
        raise InputError(
            f"a worker has oasis_warp {__version__}, the run was started by {order.version}; install the same version."
        )
    check_device(order.config.device, "--")
    check_opencv()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    networks()
    _prior(order.config.prior, order.config.backbone_weights)
    warm_up(order.config.device)


@functools.cache
def _prior(choice: Any, backbone_weights: Path | None) -> Prior:
    return choose_prior(choice, backbone_weights)


def _row(name: str, order: Order, before: Row | None) -> tuple[Row, bool]:
    """The line of one photo, and whether its results were there."""
    path, now = order.source / name, {"photo": name}
    try:
        stat = path.stat()
        now |= {"bytes": stat.st_size, "modified_ns": stat.st_mtime_ns}
        if before is not None and now.items() <= before.items() and "key" in before:
            if (order.folder(before["key"]) / ROW).is_file():
                return before, True
        with path.open("rb") as stream:
            photo = hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        return now | {"status": "failed", "said": f"{path}: cannot be read ({error.strerror})."}, False
    key = hashlib.sha256(f"{photo} {order.digest}".encode()).hexdigest()
    folder, tries = order.folder(key), order.out / TRIES / key
    kept = (folder / ROW).is_file()
    if kept:
        row = json.loads((folder / ROW).read_text())
    elif (tried := _begin(tries)) > MAX_TRIES:
        row = {"status": "failed", "said": f"{path}: its process ended {MAX_TRIES} times; it may need more memory."}
    else:
        row = _make(path, key, order) | ({"tries": tried} if tried > 1 else {})
    tries.unlink(missing_ok=True)
    return now | row, kept


def _begin(tries: Path) -> int:
    """How often this photo has been begun, this time counted."""
    make_folders(tries, tries.parent)
    tried = len(tries.read_bytes()) if tries.is_file() else 0
    with tries.open("ab") as stream:
        stream.write(b".")
    return tried + 1


def _make(path: Path, key: str, order: Order) -> Row:
    """Reconstruct one photo and write its folder; what faults of our own leave is said and not kept."""
    start, seconds = time.perf_counter(), {}
    made, row, photos = None, {"key": key, "status": "refused"}, list[Photo]()
    try:
        try:
            with timed_stage("read", seconds):
                photos.append(read_photo(path))
            made = reconstruct(photos[0], order.config, prior=_prior(order.config.prior, order.config.backbone_weights))
        except InputError as error:
            row["said"] = str(error)
        with new_folder(order.folder(key)) as part:
            if made is not None:
                write_results(part, photos, made, order.config, seconds, pictures=order.pictures)
                measures = {name: round(made.errors[name], 4) for name in MEASURES if name in made.errors}
                row |= {"status": "made", "side": made.fit.side, **measures, "warnings": list(made.warnings)}
            row["seconds"] = round(time.perf_counter() - start, 2)
            (part / ROW).write_text(json.dumps(row) + "\n")
    except InputError:  # of the disk: no other photo can be written either
        raise
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        message = f"{path}: {type(error).__name__} in {Path(place.filename).name}:{place.lineno}: {error}"
        return {"status": "failed", "said": str(InputError(message))}  # on one line, and not for pages
    return row
