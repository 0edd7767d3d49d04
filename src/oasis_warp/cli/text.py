"""`oasis text`: an avatar from words, by a generator of the user's."""

import json
import sys
from pathlib import Path

from rich.console import Console

from oasis_warp.cli.options import Text
from oasis_warp.cli.progress import Terminal, show_progress
from oasis_warp.cli.reconstruct import reconstruct_folder
from oasis_warp.cli.report import print_report
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import output_folder
from oasis_warp.data.pictures import write_picture
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.hand.template import bundled_hand
from oasis_warp.text import choose_generator, imagine, keypoints, make_conditioning, write_conditioning

SIZES = (256, 4096)
"""Least and most pixels of a side."""


def run(options: Text) -> int:
    """Write the conditioning, and with a generator the picture and its avatar.

    Raises:
        InputError: an option is wrong, the generator fails, or no picture shows the hand.
    """
    if not SIZES[0] <= options.size <= SIZES[1]:
        raise InputError(f"--size {options.size}: expected {SIZES[0]} to {SIZES[1]} pixels; choose another size.")
    if options.tries < 1:
        raise InputError(f"--tries {options.tries}: expected at least 1; choose a larger number.")
    if not options.words.strip():
        raise InputError('words: expected a description, got none; write e.g. "a fisherman\'s tanned hand".')
    generator = None if options.generator is None else choose_generator(options.generator)
    hand = bundled_hand()
    conditioning = make_conditioning(hand, options.pose, options.view, options.side, options.size)
    prompt = make_prompt(options)
    with output_folder(options.out) as part:
        write_conditioning(part, conditioning)
        (part / "prompt.txt").write_text(prompt + "\n", encoding="utf-8")
    if generator is None:
        print(
            f"{options.out}: depth.png, normal.png, canny.png, mask.png and prompt.txt are written. Make a picture "
            f"from them with an image generator and run this again with --generator PICTURE. --generator also takes "
            f"the folder of a diffusers ControlNet pipeline, or a command.",
            file=sys.stderr,
        )
        return 0
    tries = 1 if Path(options.generator or "").is_file() else options.tries  # a file does not change
    with show_progress(Terminal()) as progress:
        made = imagine(
            generator, HandEstimator(hand), conditioning, options.out, prompt,
            seed=options.seed, tries=tries, progress=progress,
        )  # fmt: skip
    with output_folder(options.out) as part:
        write_picture(part / "picture.png", made.photo.rgb)
        (part / "pose.json").write_text(json.dumps(keypoints(conditioning, made.photo.rgb.shape[1]), indent=1))
    print(f"seed {made.seed}: the landmarks are {made.distance:.1f} % of the hand's size off", file=sys.stderr)
    config = ReconstructConfig(seed=options.seed)
    report = reconstruct_folder([options.out / "picture.png"], options.out, config, options.out / "pose.json")
    print_report(Console(), report)
    return 0


def make_prompt(options: Text) -> str:
    """The words, and what the pictures to follow show."""
    seen = "the palm" if options.view == "palm" else "the back"
    pose = f"{options.pose} pose".replace("_", " ")
    return f"{options.words.strip()}, photo of {seen} of one {options.side} hand, {pose}, plain background"
