"""What a run did, how long it took and how well it went: as JSON for programs, as a table for people."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from oasis_warp import __version__
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.types import HandFit, Photo
from oasis_warp.fusion import FusedReconstruction
from oasis_warp.reconstruction import Reconstruction

MEASURES = {
    "reprojection_percent": ("landmarks miss the model by", "{:.1f} % of the hand"),
    "worst_point_percent": ("the worst of them by", "{:.1f} %"),
    "mask_iou": ("overlap of fit and mask", "{:.3f}"),
    "refined_px": ("refinement moved the surface by", "{:.1f} px"),
    "input_psnr_db": ("likeness to the photo", "{:.1f} dB"),
    "input_psnr_inner_db": ("likeness away from the outline", "{:.1f} dB"),
    "render_mask_iou": ("overlap of avatar and mask", "{:.3f}"),
    "seen_percent": ("surface that the photo shows", "{:.0f} %"),
    "grazed_percent": ("surface that it grazes", "{:.0f} %"),
    "extrapolated_percent": ("surface that it does not show", "{:.0f} %"),
    "palm_seen_percent": ("palm that it shows", "{:.0f} %"),
    "back_seen_percent": ("back that it shows", "{:.0f} %"),
    "nail_seen_percent": ("nails that it shows", "{:.0f} %"),
    "uncertainty_mean": ("mean uncertainty", "{:.2f}"),
    "n_gaussians": ("Gaussians", "{:.0f}"),
}
"""Words and unit for what `Reconstruction.errors` holds; a measure without an entry is shown under its own name."""


def make_report(
    photo: Photo, made: Reconstruction, config: ReconstructConfig, stages: Mapping[str, float]
) -> dict[str, Any]:
    """Everything about a run that JSON can hold; `stages` [s] replaces `made.stages`."""
    return {
        "creator": f"oasis_warp {__version__}",
        "photo": about_photo(photo),
        "hand": about_hand(made.fit),
        "prior": dict(made.prior),
        "config": asdict(config),
        "seconds": {**stages, "total": sum(stages.values())},
        "errors": made.errors,
        "warnings": list(made.warnings),
    }


def about_photo(photo: Photo) -> dict[str, Any]:
    """What was read."""
    height, width = photo.rgb.shape[:2]
    return {
        "name": photo.name,
        "width": width,
        "height": height,
        "shrink": photo.shrink,
        "focal_px": photo.focal,
        "has_alpha": photo.alpha is not None,
    }


def about_hand(fit: HandFit) -> dict[str, Any]:
    """What was found."""
    landmarks = fit.landmarks
    return {
        "side": fit.side,
        "side_score": landmarks.side_score,
        "presence": landmarks.presence,
        "landmarks_from": landmarks.source,
    }


def to_json(report: Mapping[str, Any]) -> str:
    """`report` as JSON; a number that is not finite becomes null, a path its text."""

    def clean(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: clean(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [clean(item) for item in value]
        if isinstance(value, Path):
            return str(value)
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(clean(report), indent=2, allow_nan=False) + "\n"


def print_report(console: Console, report: Mapping[str, Any]) -> None:
    """Print the stages with their times, the measures and the warnings in words."""
    title = f"{report['photo']['name']}: {report['hand']['side']} hand, prior {report['prior']['name']}"
    table = Table(title=title, show_header=False)
    table.add_column()
    table.add_column(justify="right")
    for stage, seconds in report["seconds"].items():
        table.add_row(stage, f"{seconds:.2f} s", end_section=stage == "total")
    for name, value in report["errors"].items():
        words, unit = MEASURES.get(name, (name, "{:.4g}"))
        table.add_row(words, unit.format(value))
    console.print(table)
    print_warnings(console, report["warnings"])


def print_warnings(console: Console, warnings: Sequence[str]) -> None:
    """A line each."""
    for warning in warnings:
        console.print(f"Warning: {warning}", style="yellow", highlight=False, soft_wrap=True)


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
