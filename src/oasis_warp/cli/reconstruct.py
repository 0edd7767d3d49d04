"""`oasis reconstruct`: photos in, a folder with an avatar out for each, or one for all of the same hand."""

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

from rich.console import Console

from oasis_warp.cli.animate import turntable
from oasis_warp.cli.console import BAD_INPUT, INTERRUPTED, check_device, show_progress
from oasis_warp.cli.options import Reconstruct
from oasis_warp.cli.report import make_fused_report, make_report, print_fused_report, print_report, to_json
from oasis_warp.cli.summary import GROUND, draw_fused_summary, draw_quality, draw_summary
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, timed_stage
from oasis_warp.data.output_files import output_folder
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import write_picture, write_video
from oasis_warp.fusion import reconstruct_same_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.network.weights_file import read_header
from oasis_warp.reconstruction import reconstruct

CROP_SIDES = (64, 1024)
"""Sides of the crop that make sense [px]: fewer show no fingers, more take too long."""
TURNTABLE_FRAMES, TURNTABLE_FPS, TURNTABLE_SIZE = 48, 16.0, 320


def run(options: Reconstruct) -> int:
    """Reconstruct every photo; the exit code.

    Raises:
        InputError: an option is wrong, or the one photo cannot be turned into an avatar.
    """
    check_device(options.device)
    _check_photos(options)
    _check_numbers(options)
    if isinstance(options.prior, Path):
        read_header(options.prior)  # once, and not again for every photo
    config = ReconstructConfig(**{field.name: getattr(options, field.name) for field in fields(ReconstructConfig)})
    if len(options.photos) == 1:  # with --same-hand too: there is nothing to fuse
        print_report(Console(), _reconstruct_one(options.photos[0], options.out, config, options.keypoints))
        return 0
    if options.same_hand:
        print_fused_report(Console(), _reconstruct_same_hand(options.photos, options.out, config))
        return 0
    return _reconstruct_all(options, config)


def _check_photos(options: Reconstruct) -> None:
    if not options.photos:
        raise InputError("photos: expected at least one, got none; name them after `oasis reconstruct`.")
    if len(options.photos) > 1 and options.keypoints is not None:
        raise InputError("--keypoints: belongs to one photo, but several were given; run them one by one.")
    if options.same_hand:
        return
    counts = Counter(photo.stem for photo in options.photos)
    if twins := [str(photo) for photo in options.photos if counts[photo.stem] > 1]:
        raise InputError(f"photos: {' and '.join(twins)} would share one output folder; run them one by one.")


def _check_numbers(options: Reconstruct) -> None:
    low, high = CROP_SIDES
    if options.size != "auto" and not low <= options.size <= high:
        raise InputError(f"--size {options.size}: expected {low} to {high} pixels; choose another size.")
    if options.steps is not None and options.steps < 0:
        raise InputError(f"--steps {options.steps}: expected 0 or more; leave it out to stop by itself.")
    if isinstance(options.hand, int) and options.hand < 0:
        raise InputError(f"--hand {options.hand}: expected 0 or more; 0 is the best hand found.")


def _reconstruct_all(options: Reconstruct, config: ReconstructConfig) -> int:
    """Every photo into its own folder; one that fails does not stop the others."""
    n_photos, n_done = len(options.photos), 0
    failed: list[str] = []
    with _shared_folder(options.out):
        try:
            for number, photo in enumerate(options.photos, 1):
                print(f"{photo}, {number} of {n_photos}", file=sys.stderr)
                try:
                    report = _reconstruct_one(photo, options.out / photo.stem, config, None)
                except InputError as error:
                    print(f"oasis: {error}", file=sys.stderr)
                    failed.append(str(photo))
                else:
                    print_report(Console(), report)
                    n_done += 1
        except KeyboardInterrupt:
            print(f"oasis: stopped; {n_done} of {n_photos} photos are done.", file=sys.stderr)
            return INTERRUPTED
    if failed:
        print(f"oasis: {n_done} of {n_photos} photos are done; failed: {', '.join(failed)}.", file=sys.stderr)
        return BAD_INPUT
    return 0


@contextmanager
def _shared_folder(path: Path) -> Iterator[None]:
    """Make the folder that holds everyone's, and take it away again if it stays empty."""
    if path.exists():
        yield
        return
    with output_folder(path):
        pass
    try:
        yield
    finally:
        if not any(path.iterdir()):
            path.rmdir()


def _reconstruct_one(path: Path, folder: Path, config: ReconstructConfig, keypoints: Path | None) -> dict[str, Any]:
    """Write one avatar's folder; its report."""
    seconds: dict[str, float] = {}
    with output_folder(folder) as part, show_progress(Console(stderr=True)) as progress:
        with timed_stage("read", seconds):
            photo = read_photo(path)
        made = reconstruct(photo, config, keypoints=keypoints, progress=progress)
        seconds.update(made.stages)
        with timed_stage("summary", seconds):
            write_picture(part / "summary.png", draw_summary(photo, made, progress=progress))
            write_picture(part / "quality.png", draw_quality(photo.name, made.avatar, made.quality))
        _write_avatar(part, made.avatar, seconds, progress)
        report = make_report(photo, made, config, seconds)
        (part / "report.json").write_text(to_json(report))
    return report


def _reconstruct_same_hand(paths: Sequence[Path], folder: Path, config: ReconstructConfig) -> dict[str, Any]:
    """Write the folder of one avatar of all photos; its report."""
    seconds: dict[str, float] = {}
    with output_folder(folder) as part, show_progress(Console(stderr=True)) as progress:
        with timed_stage("read", seconds):
            photos = [read_photo(path) for path in paths]
        made = reconstruct_same_hand(photos, config, progress=progress)
        seconds.update(made.stages)
        with timed_stage("summary", seconds):
            write_picture(part / "summary.png", draw_fused_summary(photos, made, progress=progress))
            title = ", ".join(photo.name for photo in photos)
            write_picture(part / "quality.png", draw_quality(title, made.avatar, made.quality))
        _write_avatar(part, made.avatar, seconds, progress)
        report = make_fused_report(photos, made, config, seconds)
        (part / "report.json").write_text(to_json(report))
    return report


def _write_avatar(part: Path, avatar: Avatar, seconds: dict[str, float], progress: Progress) -> None:
    with timed_stage("turntable", seconds):
        _write_turntable(part / "turntable.mp4", avatar, progress)
    with timed_stage("save", seconds):
        avatar.save(part / "avatar.safetensors")


def _write_turntable(path: Path, avatar: Avatar, progress: Progress) -> None:
    look = {"elevation": 0.0, "background": GROUND, "progress": progress}
    frames = turntable(avatar, avatar.source_pose, TURNTABLE_FRAMES, TURNTABLE_SIZE, **look)
    write_video(path, frames, TURNTABLE_FPS)
