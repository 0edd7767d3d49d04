"""`oasis compare`: what two avatars differ in: how they were made, in numbers, and in pictures."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from oasis_warp.cli.info import FACTS, describe
from oasis_warp.cli.options import Compare
from oasis_warp.cli.progress import print_tables
from oasis_warp.cli.record import note, written
from oasis_warp.cli.report import MEASURES
from oasis_warp.cli.summary import GROUND, Panel, make_sheet, panel_side
from oasis_warp.data.json_text import read_json
from oasis_warp.data.pictures import PICTURE_SUFFIXES, check_suffix, to_uint8, write_picture
from oasis_warp.hand_avatar import Avatar

VIEWS = (("photo", 0.0), ("photo", math.pi), ("fist", 0.0))
"""Poses, and directions to see them from [rad]."""
WIDTH, MAGNIFIED = 1200, 4.0
"""Width of the sheet [px], and the factor by which it magnifies differences."""


def run(options: Compare) -> int:
    """Print what differs, and draw both avatars side by side.

    Raises:
        InputError: a wrong avatar file or output.
    """
    if options.out is not None:
        check_suffix(options.out, PICTURE_SUFFIXES)
    avatars, facts = zip(*map(_facts, (options.one, options.other)), strict=True)
    rows = [(name, form, *(own.get(key) for own in facts)) for key, (name, form) in _names(facts).items()]
    different = [row for row in rows if row[2] != row[3]]
    table = Table()
    for heading in ("", str(options.one), str(options.other)):
        table.add_column(heading, overflow="fold")
    for name, form, *values in different:
        table.add_row(name, *("-" if value is None else form.format(value) for value in values))
    names = [path.parent.name or path.stem for path in (options.one, options.other)]
    sheet, likeness = draw_comparison(*avatars, names)
    for (pose, azimuth), psnr in zip(VIEWS, likeness, strict=True):
        table.add_row(f"PSNR, {_view(pose, azimuth)}", "", "identical" if psnr == math.inf else f"{psnr:.1f} dB")
    print_tables([table], 80)
    note(different={name: values for name, _, *values in different}, likeness_db=likeness)
    if options.out is not None:
        write_picture(options.out, sheet)
        written(options.out)
    return 0


def _facts(path: Path) -> tuple[Avatar, dict[str, Any]]:
    """An avatar, and its facts with settings and measures of the report beside it, if one is there."""
    avatar, facts = describe(path)
    report: dict[str, Any] = {}
    try:
        report = read_json(path.with_name("report.json").read_bytes())
    except (OSError, ValueError):  # it was moved, or is no report
        pass
    parts = (report.get(name) for name in ("config", "errors"))
    config, errors = (part if isinstance(part, dict) else {} for part in parts)
    settings = {f"--{name.replace('_', '-')}": _plain(value) for name, value in config.items()}
    return avatar, {**facts, **settings, **{name: value for name, value in errors.items() if name in MEASURES}}


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _names(facts: Sequence[dict[str, Any]]) -> dict[str, tuple[str, str]]:
    """Name and form of everything that either of them has."""
    settings = {key: (key, "{}") for own in facts for key in own if key.startswith("--")}
    return {**FACTS, **settings, **MEASURES}


def _view(pose: str, azimuth: float) -> str:
    return f"{pose} from behind" if azimuth else pose


@torch.no_grad()
def draw_comparison(one: Avatar, other: Avatar, names: list[str]) -> tuple[torch.Tensor, list[float]]:
    """A sheet with a row for each avatar and one for their differences, and the PSNR [dB] of each view."""
    side = panel_side(len(VIEWS), WIDTH)
    rows: list[list[Panel]] = [[], [], []]
    likeness = []
    for pose, azimuth in VIEWS:
        drawn = []
        for avatar in (one, other):
            held = avatar.source_pose if pose == "photo" else avatar.held(pose)
            drawn.append(avatar.render(avatar.orbit_camera(held, azimuth, size=side), held, GROUND).image)
        error = float((drawn[0] - drawn[1]).square().mean())
        likeness.append(-10 * math.log10(error) if error else math.inf)
        apart = 0.5 + MAGNIFIED * (drawn[1] - drawn[0]) / 2
        captions = [f"{name}, {_view(pose, azimuth)}" for name in names] + [f"second minus first, {MAGNIFIED:g} times"]
        for row, picture, caption in zip(rows, (*drawn, apart), captions, strict=True):
            row.append(Panel(to_uint8(picture).numpy(), caption))
    return torch.from_numpy(make_sheet("Comparison", " and ".join(names), rows, WIDTH)), likeness
