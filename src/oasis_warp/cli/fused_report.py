"""The report of an avatar of several photos: as of one, and what each photo gave."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table

from oasis_warp import __version__
from oasis_warp.cli.report import about_hand, about_photo, print_warnings
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.types import Photo
from oasis_warp.fusion import FusedReconstruction

COLUMNS = {
    "seen_percent": ("shows", "{:.0f} %"),
    "best_percent": ("best in", "{:.0f} %"),
    "reprojection_percent": ("landmarks off", "{:.1f} %"),
    "mask_iou": ("fit and mask", "{:.3f}"),
    "input_psnr_db": ("likeness", "{:.1f} dB"),
}
"""Heading and unit of what the table says of each photo; shares are of the hand's surface."""


def make_fused_report(
    photos: Sequence[Photo], made: FusedReconstruction, config: ReconstructConfig, stages: Mapping[str, float]
) -> dict[str, Any]:
    """Everything about a run that JSON can hold; `stages` [s] replaces `made.stages`."""
    return {
        "creator": f"oasis_warp {__version__}",
        "photos": [
            {
                "photo": about_photo(photo),
                "hand": about_hand(own.fit),
                "gain": list(own.gain),
                "errors": own.errors,
            }
            for photo, own in zip(photos, made.photos, strict=True)
        ],
        "hand": {"side": made.avatar.side},
        "prior": dict(made.prior),
        "config": asdict(config),
        "seconds": {**stages, "total": sum(stages.values())},
        "errors": made.errors,
        "warnings": list(made.warnings),
    }


def print_fused_report(console: Console, report: Mapping[str, Any]) -> None:
    """Print a line for every photo, and the warnings in words."""
    title = f"{len(report['photos'])} photos of a {report['hand']['side']} hand, prior {report['prior']['name']}"
    seen, seconds = report["errors"]["seen_percent"], report["seconds"]["total"]
    table = Table(title=title, caption=f"together {seen:.0f} % of the surface, {seconds:.1f} s")
    table.add_column("photo")
    for heading, _ in COLUMNS.values():
        table.add_column(heading, justify="right")
    for own in report["photos"]:
        table.add_row(own["photo"]["name"], *(unit.format(own["errors"][name]) for name, (_, unit) in COLUMNS.items()))
    console.print(table)
    print_warnings(console, report["warnings"])
