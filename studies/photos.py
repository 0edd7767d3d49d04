"""What is measured of the avatars of all photos of the tests, with the learned prior and without.

Fills docs/results.md (avatar, single). Avatars stay in OUT/photos/avatars.
"""

import resource
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.evaluation.metrics import coverage
from oasis_warp.evaluation.same_hand import photos_in
from oasis_warp.reconstruction import reconstruct
from studies.harness import Row, StudyOptions, measured, prior_choice
from studies.inputs import PHOTOS, SAME_HAND, photos_below
from studies.tables import Column, Section, complete, distribution, groups, table

AVATAR = (
    Column("PSNR inside the mask, dB", "input_psnr_db", ".1f"),
    Column("PSNR 2 px inside the mask, dB", "input_psnr_inner_db", ".1f"),
    Column("coverage, worst of 4 poses x 8 views", "coverage_worst", ".4f"),
    Column("seconds: prior", "prior_s", ".2f"),
    Column("seconds: adaptation", "adaptation_s", ".1f"),
    Column("seconds: photo to avatar, warm", "total_s", ".1f"),
    Column("peak memory of the process, GiB", "peak_gib", ".2f"),
)
SINGLE = (
    Column("PSNR dB", "input_psnr_db", ".1f"),
    Column("2 px inside, dB", "input_psnr_inner_db", ".1f"),
    Column("coverage", "coverage_worst", ".3f"),
)


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    selecting: ClassVar[frozenset[str]] = frozenset({"priors", "folders"})
    priors: tuple[str, ...] = ("none", "learned")
    """none, learned, or weights files."""
    folders: tuple[Path, ...] = (PHOTOS, SAME_HAND)
    """Folders of photos, or of folders of photos."""
    seed: int = 0
    size: int | None = None
    """Side of the crop [px]; that of the photo by default."""


def measure_avatar(path: Path, prior: str, options: Options) -> Row:
    """One photo's row; writes its avatar."""
    start = time.perf_counter()
    config = ReconstructConfig(
        prior=prior_choice(prior), seed=options.seed, size=options.size or "auto", device=options.device
    )
    about = {"photo": path.stem, "folder": path.parent.name, "prior": prior}
    try:
        made = reconstruct(read_photo(path), config)
    except InputError as error:
        return {**about, "result": str(error)}
    total_s, shares = time.perf_counter() - start, coverage(made.avatar)
    folder = options.out / "photos" / "avatars" / Path(prior).stem / path.parent.name
    folder.mkdir(parents=True, exist_ok=True)
    made.avatar.save(folder / f"{path.stem}.safetensors")
    return {
        **about, "result": "ok", "side": made.fit.side, **made.errors, "coverage_worst": float(shares.min()),
        "coverage_mean": float(shares.mean()), **{f"{stage}_s": value for stage, value in made.stages.items()},
        "total_s": total_s, "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "warnings": list(made.warnings),
    }  # fmt: skip


def run(options: Options) -> list[Row]:
    """Measure every photo with every prior."""
    paths = [path for folder in options.folders for path in photos_in(folder) or photos_below(folder)]
    cases = {f"{path}, {prior}": (path, prior, options) for prior in options.priors for path in paths}
    return measured("photos", cases, measure_avatar, options)


# ---- tables


def reconstructed(rows: list[Row], prior: str | None = None) -> list[Row]:
    """The rows of avatars, of one prior."""
    return [row for row in complete(rows) if row.get("result") == "ok" and prior in (None, row["prior"])]


def avatar_text(rows: list[Row]) -> str | None:
    """The avatars' measures over all hands."""
    title = f"all {len(reconstructed(rows, 'none'))} hands"
    return distribution(reconstructed(rows), AVATAR, title, by="prior", extremes=True)


def single_rows(rows: list[Row]) -> list[Row]:
    """A row for each single photo, with the measures of every prior."""
    found = []
    singles = [row for row in complete(rows) if row.get("folder") == PHOTOS.name]
    for (name,), own in groups(singles, "photo").items():
        if own[0]["result"] != "ok":
            found.append({"photo": name, "side": f"refused: {own[0]['result'].split(': ')[1].split(';')[0]}"})
            continue
        measures = {f"{each.value} {row['prior']}": row.get(each.value) for row in own for each in SINGLE}
        found.append({**own[0], **measures})
    return sorted(found, key=lambda row: row["photo"])


SECTIONS = (
    Section("results.md", "avatar", avatar_text),
    Section("results.md", "single", table(
        (
            Column("photo", "photo"), Column("side", "side"), Column("reprojection %", "reprojection_percent", ".2f"),
            Column("mask IoU", "mask_iou", ".3f"),
            *(
                Column(f"{each.heading}, {prior}", f"{each.value} {prior}", each.form)
                for each in SINGLE for prior in ("none", "learned")
            ),
        ),
        single_rows,
    )),
)  # fmt: skip
