"""`oasis reconstruct`: a folder with an avatar for each photo, or for all photos of the same hand."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

from oasis_warp.cli.animate import turntable
from oasis_warp.cli.options import Reconstruct
from oasis_warp.cli.progress import (
    BAD_INPUT,
    INTERRUPTED,
    Run,
    Terminal,
    plain_console,
    reconstruct_plan,
    show_run,
)
from oasis_warp.cli.record import written
from oasis_warp.cli.report import make_report, print_report, to_json
from oasis_warp.cli.summary import GROUND, draw_quality, draw_summary
from oasis_warp.core.config import ReconstructConfig, check_config
from oasis_warp.core.devices import check_device
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress, silent, timed_stage
from oasis_warp.core.processes import single_threaded_math
from oasis_warp.core.types import Photo
from oasis_warp.data.output_files import check_apart, make_folders, output_folder
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import write_picture, write_video
from oasis_warp.estimation.estimator import HandEstimator, choose_hand, palm_and_back
from oasis_warp.hand.template import bundled_hand
from oasis_warp.losses import Perceptual, load_lpips
from oasis_warp.network.weights_file import read_header
from oasis_warp.reconstruction import FusedReconstruction, Reconstruction, reconstruct, reconstruct_same_hand

TURNTABLE_FRAMES, TURNTABLE_FPS, TURNTABLE_SIZE = 48, 16.0, 320


def run(options: Reconstruct) -> int:
    """Reconstruct every photo; the exit code.

    Raises:
        InputError: an option is wrong, or the one photo cannot be turned into an avatar.
    """
    check_device(options.device, "--")
    _check_photos(options)
    config = ReconstructConfig(**{field.name: getattr(options, field.name) for field in fields(ReconstructConfig)})
    check_config(config, "--")
    if isinstance(options.prior, Path):
        read_header(options.prior)  # check it once, not for every photo
    perceptual = None
    if options.lpips is not None:
        perceptual = load_lpips(*options.lpips, allow_download=options.allow_download).to(config.device)
    if len(options.photos) == 1 or options.same_hand or _is_one_hand(options):
        _print(reconstruct_folder(options.photos, options.out, config, options.keypoints, perceptual), options.out)
        return 0
    return _reconstruct_all(options, config, perceptual)


def _check_photos(options: Reconstruct) -> None:
    if not options.photos:
        raise InputError("photos: expected at least one, got none; name them after `oasis reconstruct`.")
    if len(options.photos) > 1 and options.keypoints is not None:
        raise InputError("--keypoints: works with one photo, but several were given; run them one by one.")
    if not options.same_hand:
        names = [photo.stem for photo in options.photos]
        check_apart(options.photos, names, "output folder", "run them one by one")


def _is_one_hand(options: Reconstruct) -> bool:
    """Ask on a terminal whether a palm and a back are of one hand; without a terminal say how to make one avatar."""
    if len(options.photos) != 2:
        return False
    estimator = HandEstimator(bundled_hand())
    try:
        one, other = (
            choose_hand(estimator.find(photo), options.hand, photo.name) for photo in map(read_photo, options.photos)
        )
    except InputError:  # said where each photo is reconstructed
        return False
    if not palm_and_back(one, other):
        return False
    seen = f"The photos show the palm and the back of a {one.side} hand."
    if sys.stdin.isatty() and sys.stderr.isatty():
        print(f"{seen} Is it one hand, to make one avatar of both? [Y/n] ", end="", file=sys.stderr, flush=True)
        return sys.stdin.readline().lower() in ("\n", "y\n", "yes\n")
    print(f"{seen} If both show the same hand, --same-hand makes one avatar of them.", file=sys.stderr)
    return False


def _reconstruct_all(options: Reconstruct, config: ReconstructConfig, perceptual: Perceptual | None) -> int:
    """Reconstruct every photo into its own folder; one that fails does not stop the others."""
    n_photos, n_done = len(options.photos), 0
    failed: list[str] = []
    planned = Run(reconstruct_plan(config, 1), n_photos)
    with _shared_folder(options.out), show_run(Terminal(), planned) as shown:
        try:
            for k, photo in enumerate(options.photos):
                planned.begin(k, f"photo {k + 1} of {n_photos}")
                folder = options.out / photo.stem
                try:
                    report = _write_folder([photo], folder, config, None, perceptual, shown.progress)
                except InputError as error:
                    with shown.paused():
                        print(f"oasis: {error}", file=sys.stderr)
                    failed.append(str(photo))
                else:
                    with shown.paused():
                        _print(report, folder)
                    n_done += 1
        except KeyboardInterrupt:
            with shown.paused():
                print(f"oasis: stopped; {n_done} of {n_photos} photos are done.", file=sys.stderr)
            return INTERRUPTED
    if failed:
        print(f"oasis: {n_done} of {n_photos} photos are done; failed: {', '.join(failed)}.", file=sys.stderr)
        return BAD_INPUT
    return 0


@contextmanager
def _shared_folder(path: Path) -> Iterator[None]:
    """Create the folder of all results and those above it, and remove those again that stay empty."""
    made = make_folders(path, path)
    try:
        yield
    finally:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()


def reconstruct_folder(
    paths: Sequence[Path], folder: Path, config: ReconstructConfig, keypoints: Path | None = None,
    perceptual: Perceptual | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Reconstruct one avatar of the hand on all photos, and write its folder; its report. Shows progress."""
    with show_run(Terminal(), Run(reconstruct_plan(config, len(paths)))) as shown:
        return _write_folder(paths, folder, config, keypoints, perceptual, shown.progress)


def _print(report: dict[str, Any], folder: Path) -> None:
    print_report(plain_console(), report)
    written(f"{folder}{os.sep}")


@single_threaded_math()
def _write_folder(
    paths: Sequence[Path], folder: Path, config: ReconstructConfig, keypoints: Path | None,
    perceptual: Perceptual | None, progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    seconds: dict[str, float] = {}
    with output_folder(folder) as part:
        with timed_stage("read", seconds):
            photos = [read_photo(path) for path in paths]
        if len(photos) == 1:
            made = reconstruct(photos[0], config, keypoints=keypoints, perceptual=perceptual, progress=progress)
        else:
            made = reconstruct_same_hand(photos, config, perceptual=perceptual, progress=progress)
        return write_results(part, photos, made, config, seconds, progress=progress)


def write_results(
    folder: Path, photos: Sequence[Photo], made: Reconstruction | FusedReconstruction, config: ReconstructConfig,
    seconds: dict[str, float], *, pictures: bool = True, progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """Write the avatar, its report and, if asked for, its pictures to a folder that is there; the report.

    `seconds` of what came before are continued.
    """
    avatar, names = made.avatar, ", ".join(photo.name for photo in photos)
    seconds.update(made.stages)
    if pictures:
        with timed_stage("summary", seconds, progress):
            write_picture(folder / "summary.png", draw_summary(photos, made, progress=progress))
            write_picture(folder / "quality.png", draw_quality(names, avatar, made.quality))
        with timed_stage("turntable", seconds, progress):
            frames = turntable(
                avatar, avatar.source_pose, TURNTABLE_FRAMES, TURNTABLE_SIZE, elevation=0.0, background=GROUND,
                progress=progress,
            )  # fmt: skip
            write_video(folder / "turntable.mp4", frames, TURNTABLE_FPS)
    with timed_stage("save", seconds, progress):
        avatar.save(folder / "avatar.safetensors")
    report = make_report(photos, made, config, seconds)
    (folder / "report.json").write_text(to_json(report))
    return report
