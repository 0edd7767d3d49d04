"""Contrasts of the skin of real hands, by side and size of detail: the yardstick of `oasis evaluate --dataset looks`.

Writes src/oasis_warp/assets/evaluation/real_hands.json and fills docs/looks.md (real-hands).
"""

import json
from dataclasses import dataclass
from pathlib import Path

from oasis_warp.data.output_files import write_file
from oasis_warp.data.photo import read_photo
from oasis_warp.evaluation.band_energy import BANDS
from oasis_warp.evaluation.real_hands import measure_real, real_photos, summarise_real
from studies.harness import Row, StudyOptions, measured
from studies.inputs import PHOTOS, estimator
from studies.tables import Column, Section, complete, table

TABLE = Path(__file__).parents[1] / "src" / "oasis_warp" / "assets" / "evaluation" / "real_hands.json"


@dataclass(frozen=True, kw_only=True)
class Options(StudyOptions):
    """Options of this study."""

    photos: Path = PHOTOS
    """Folder of photos; those of a subfolder show one hand."""


def measure_contrast(path: Path, hand: str) -> Row:
    """One photo's row."""
    found = measure_real(read_photo(path), estimator())
    return {"hand": hand, "photo": path.name, **{name: found[name] for name in ("crop_px", "contrast", "darkest")}}


def run(options: Options) -> list[Row]:
    """Measure every photo and write the table that ships."""
    cases = {f"{hand}/{path.name}": (path, hand) for path, hand in real_photos(options.photos).items()}
    rows = measured("real_hands", cases, measure_contrast, options)
    write_file(TABLE, (json.dumps(summarise_real(complete(rows)), indent=1) + "\n").encode())
    return rows


def sides(rows: list[Row]) -> list[Row]:
    """A row for palm and back."""
    return [
        {"side": side, **{name: own[name] for name in ("photos", "hands")},
         **{band: f"{own['median'][k]:.1f} ({own['quarter'][k]:.1f} to {own['three_quarters'][k]:.1f})"
            for k, band in enumerate(BANDS)}}
        for side, own in summarise_real(complete(rows)).items()
    ]  # fmt: skip


SECTIONS = (
    Section("looks.md", "real-hands", table(
        (
            Column("side", "side"), Column("photos", "photos", "d"), Column("hands", "hands", "d"),
            *(Column(f"{band} px", band) for band in BANDS),
        ),
        sides,
    )),
)  # fmt: skip
