"""`oasis edit`: bring what was painted on a photo into the avatar."""

import math
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from oasis_warp import __version__
from oasis_warp.cli.options import Edit as Options
from oasis_warp.cli.progress import EDIT_PLAN, Run, Terminal, plain_console, show_run
from oasis_warp.cli.record import exact_command, written
from oasis_warp.cli.report import measures_table, print_warnings, to_json
from oasis_warp.cli.summary import GROUND, WIDTH, Panel, make_sheet, panel_side
from oasis_warp.core.camera import crop_camera
from oasis_warp.core.config import EditConfig, check_config
from oasis_warp.core.devices import check_device
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import timed_stage
from oasis_warp.core.types import Camera, HandPose
from oasis_warp.data.output_files import output_folder, write_file
from oasis_warp.data.pictures import to_uint8, write_picture
from oasis_warp.data.square_crop import resample_square
from oasis_warp.editing import Edit, edit
from oasis_warp.hand_avatar import Avatar

ANGLE = 0.5
"""Angle of the other views in the summary [rad]."""
POSES = ("open", "fist", "point")
MEASURES = {
    "painted_mm2": ("skin painted", "{:.0f} mm²"),
    "new_gaussians": ("new Gaussians", "{:.0f}"),
    "n_gaussians": ("Gaussians", "{:.0f}"),
    "left_out_percent": ("paint left out, at grazing angles", "{:.1f} %"),
    "input_psnr_db": ("PSNR to the painted photo", "{:.1f} dB"),
    "unchanged_psnr_db": ("PSNR to before, outside the paint", "{:.1f} dB"),
}
"""Name and unit of the measures in `Edit.measures`."""


def run(options: Options) -> int:
    """Write the new avatar, its summary and its report: all three, or none.

    Raises:
        InputError: a wrong file or option, an output that exists, or no paint on the hand.
    """
    check_device(options.device, "--")
    config = EditConfig(steps=options.steps, size=options.size)
    check_config(config, "--")
    out = options.out or options.avatar.with_name(f"{options.avatar.stem}-{options.painted.stem}.safetensors")
    if out.suffix != ".safetensors":
        raise InputError(f"{out}: expected a name that ends in .safetensors; rename the output.")
    with output_folder(out.parent) as part, show_run(Terminal(), Run(EDIT_PLAN)) as shown:
        _check_outputs(options, out)
        before = Avatar.load(options.avatar, options.device)
        made = edit(
            before,
            options.painted,
            photo=options.photo,
            mask=options.mask,
            config=config,
            progress=shown.progress,
        )
        with timed_stage("summary", made.stages, shown.progress):
            summary = draw_edit(before, made, options.painted.name)
        report = _report(options, made)
        picture, notes, avatar = (part / file.name for file in _outputs(out))
        write_picture(picture, summary)
        write_file(notes, to_json(report).encode())
        made.avatar.save(avatar)
    _print(plain_console(), report, out)
    return 0


def _outputs(out: Path) -> tuple[Path, Path, Path]:
    return out.with_suffix(".png"), out.with_suffix(".json"), out


def _check_outputs(options: Options, out: Path) -> None:
    given = {path.resolve() for path in (options.avatar, options.painted, options.photo, options.mask) if path}
    for file in _outputs(out):
        if file.resolve() in given:
            raise InputError(f"{file}: would replace an input of the edit; choose another name with --out.")
        if file.exists() and not options.overwrite:
            raise InputError(f"{file}: exists already; choose another name with --out, or give --overwrite.")


def _report(options: Options, made: Edit) -> dict[str, Any]:
    given = {name: path.name for name in ("avatar", "painted", "photo", "mask") if (path := getattr(options, name))}
    return {
        "creator": f"oasis_warp {__version__}",
        "command": exact_command(),
        **given,
        "square": made.square._asdict(),
        "config": {"steps": options.steps, "size": options.size},
        "seconds": {**made.stages, "total": sum(made.stages.values())},
        "measures": made.measures,
        "warnings": list(made.warnings),
    }


def _print(console: Console, report: dict[str, Any], out: Path) -> None:
    title = f"{report['painted']} on {report['avatar']}"
    console.print(measures_table(title, report["seconds"], report["measures"], MEASURES))
    written(out)
    print_warnings(console, report["warnings"])


@torch.no_grad()
def draw_edit(before: Avatar, made: Edit, title: str) -> torch.Tensor:
    """Draw the painted photo, the mask, the avatar before and after in the photo's view, and other views and poses."""
    side, after = panel_side(4, WIDTH), made.avatar
    n = len(made.image)

    def whole(picture: torch.Tensor) -> Any:
        return to_uint8(resample_square(picture.contiguous(), 0.0, 0.0, float(n), side)).numpy()

    source = after.source_camera
    camera = crop_camera(source, 0.0, 0.0, float(source.width), side)

    def draw(avatar: Avatar, camera: Camera, pose: HandPose) -> Any:
        return to_uint8(avatar.render(camera, pose, GROUND).image).numpy()

    pose = after.source_pose
    first = [
        Panel(whole(made.image), "painted photo"),
        Panel(whole(made.mask[..., None].expand(-1, -1, 3)), "paint"),
        Panel(draw(before, camera, pose), "before"),
        Panel(draw(after, camera, pose), "after"),
    ]
    side = panel_side(2 + len(POSES), WIDTH)
    second = [
        Panel(draw(after, after.orbit_camera(pose, angle, size=side), pose), f"{math.degrees(angle):.0f}°")
        for angle in (ANGLE, -ANGLE)
    ]
    for name in POSES:
        held = after.held(name)
        second.append(Panel(draw(after, after.orbit_camera(held, 0.0, size=side), held), name))
    measures = made.measures
    words = [MEASURES[name][1].format(measures[name]) for name in ("painted_mm2", "input_psnr_db")]
    words.append(f"{measures['new_gaussians']:.0f} new Gaussians")
    return torch.from_numpy(make_sheet(title, ", ".join(words), [first, second], WIDTH))
