"""The report of a run: inputs, times and measures, as JSON for programs and as a table for people."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from oasis_warp import __version__
from oasis_warp.cli.record import exact_command, is_quiet
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.types import HandFit, Photo
from oasis_warp.reconstruction import FusedReconstruction, Reconstruction

MEASURES = {
    "reprojection_percent": ("reprojection error", "{:.1f} % of the hand"),
    "worst_point_percent": ("worst landmark", "{:.1f} % of the hand"),
    "mask_iou": ("mask IoU of the fit", "{:.3f}"),
    "refined_px": ("shift by the refinement", "{:.1f} px"),
    "input_psnr_db": ("PSNR to the photo", "{:.1f} dB"),
    "input_psnr_inner_db": ("PSNR inside the outline", "{:.1f} dB"),
    "input_lpips": ("LPIPS to the photo", "{:.3f}"),
    "render_mask_iou": ("mask IoU of the avatar", "{:.3f}"),
    "seen_percent": ("surface seen", "{:.0f} %"),
    "grazed_percent": ("surface seen at grazing angles", "{:.0f} %"),
    "extrapolated_percent": ("surface unseen", "{:.0f} %"),
    "palm_seen_percent": ("palm seen", "{:.0f} %"),
    "back_seen_percent": ("back seen", "{:.0f} %"),
    "nail_seen_percent": ("nails seen", "{:.0f} %"),
    "invented_percent": ("surface inpainted", "{:.0f} %"),
    "uncertainty_mean": ("mean uncertainty", "{:.2f}"),
    "n_gaussians": ("Gaussians", "{:.0f}"),
}
"""Name and unit of the measures in `Reconstruction.errors`; others are shown under their keys."""
TITLE = 76
"""Longest title that stays on one line [characters]."""
COLUMNS = {
    "seen_percent": ("seen", "{:.0f} %"),
    "best_percent": ("best seen", "{:.0f} %"),
    "reprojection_percent": ("reprojection", "{:.1f} %"),
    "mask_iou": ("mask IoU", "{:.3f}"),
    "input_psnr_db": ("PSNR", "{:.1f} dB"),
}
"""Heading and unit of the columns for several photos; shares are of the hand's surface."""


def make_report(
    photos: Sequence[Photo],
    made: Reconstruction | FusedReconstruction,
    config: ReconstructConfig,
    stages: Mapping[str, float],
) -> dict[str, Any]:
    """All results of a run that JSON can hold; `stages` [s] replaces `made.stages`."""
    if isinstance(made, Reconstruction):
        inputs = {"photo": describe_photo(photos[0]), "hand": describe_hand(made.fit)}
    else:
        each = [
            {
                "photo": describe_photo(photo),
                "hand": describe_hand(own.fit),
                "gain": list(own.gain),
                "errors": own.errors,
            }
            for photo, own in zip(photos, made.photos, strict=True)
        ]
        inputs = {"photos": each, "hand": {"side": made.avatar.side}}
    return {
        "creator": f"oasis_warp {__version__}",
        "command": exact_command(),
        **inputs,
        "prior": dict(made.prior),
        "config": asdict(config),
        "seconds": {**stages, "total": sum(stages.values())},
        "errors": made.errors,
        "warnings": list(made.warnings),
    }


def describe_photo(photo: Photo) -> dict[str, Any]:
    """The photo as it was read."""
    height, width = photo.rgb.shape[:2]
    return {
        "name": photo.name,
        "width": width,
        "height": height,
        "shrink": photo.shrink,
        "focal_px": photo.focal,
        "has_alpha": photo.alpha is not None,
    }


def describe_hand(fit: HandFit) -> dict[str, Any]:
    """The hand as it was found."""
    landmarks = fit.landmarks
    return {
        "side": fit.side,
        "side_score": landmarks.side_score,
        "presence": landmarks.presence,
        "landmarks_from": landmarks.source,
    }


def to_json(report: Mapping[str, Any]) -> str:
    """`report` as JSON; numbers that are not finite become null, paths become text."""

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
    """Print times and measures, or for several photos a line for each, and the warnings."""
    hand = f"{report['hand']['side']} hand, prior {report['prior']['name']}"
    if "photo" in report:
        table = measures_table(f"{report['photo']['name']}: {hand}", report["seconds"], report["errors"], MEASURES)
    else:
        table = _photos_table(f"{len(report['photos'])} photos of a {hand}", report)
    console.print(table)
    print_warnings(console, report["warnings"])


def measures_table(
    title: str, seconds: Mapping[str, float], measures: Mapping[str, float], names: Mapping[str, tuple[str, str]]
) -> Table:
    """A table of the times of stages and of measures, with name and unit of each from `names`."""
    table = Table(title=title, show_header=False, min_width=min(len(title), TITLE))  # or the title is wrapped
    table.add_column()
    table.add_column(justify="right")
    for stage, duration in seconds.items():
        table.add_row(stage, f"{duration:.2f} s", end_section=stage == "total")
    for key, value in measures.items():
        name, unit = names.get(key, (key, "{:.4g}"))
        table.add_row(name, unit.format(value))
    return table


def _photos_table(title: str, report: Mapping[str, Any]) -> Table:
    seen, seconds = report["errors"]["seen_percent"], report["seconds"]["total"]
    table = Table(title=title, caption=f"all photos: {seen:.0f} % of the surface seen, {seconds:.1f} s")
    table.add_column("photo")
    for heading, _ in COLUMNS.values():
        table.add_column(heading, justify="right")
    for own in report["photos"]:
        table.add_row(own["photo"]["name"], *(unit.format(own["errors"][name]) for name, (_, unit) in COLUMNS.items()))
    return table


def print_warnings(console: Console, warnings: Sequence[str]) -> None:
    """Print a line for each warning; with --quiet, which silences `console`, on standard error."""
    if is_quiet():
        console = Console(stderr=True, markup=False)
    for warning in warnings:
        console.print(f"Warning: {warning}", style="yellow", highlight=False, soft_wrap=True)
