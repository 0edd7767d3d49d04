"""`oasis synthesize`: pictures of synthetic hands, as shards for training or as one contact sheet."""

import sys

import torch

from oasis_warp.cli.developer_options import Synthesize
from oasis_warp.cli.progress import INTERRUPTED, Terminal, show_progress
from oasis_warp.core.devices import check_device
from oasis_warp.core.errors import InputError
from oasis_warp.core.logging import Progress
from oasis_warp.data.pictures import PICTURE_SUFFIXES, check_suffix, contact_sheet, to_uint8, write_picture
from oasis_warp.synthetic.picture import render_batch
from oasis_warp.synthetic.rooms import list_backgrounds
from oasis_warp.synthetic.shards import write_shards
from oasis_warp.synthetic.shots import PICTURES_EACH, SceneConfig

SHEET_COLUMNS = 8
BATCH = {"cpu": 4, "cuda": 64}
SIZES = range(32, 1025)


def run(options: Synthesize) -> int:
    """Write the pictures; Ctrl-C keeps complete shards.

    Raises:
        InputError: a wrong option, folder or output.
    """
    check_device(options.device, "--")
    if options.count < 1:
        raise InputError(f"--count: expected 1 or more, got {options.count}; say how many pictures to make.")
    if options.size not in SIZES:
        raise InputError(f"--size: expected {SIZES[0]} to {SIZES[-1]} pixels, got {options.size}; choose another size.")
    if options.seed < 0:
        raise InputError(f"--seed: expected 0 or more, got {options.seed}; choose another seed.")
    folder = () if options.backgrounds is None else list_backgrounds(options.backgrounds)
    scene = SceneConfig(look=options.look, backgrounds=folder)
    console = Terminal()
    with show_progress(console) as progress:
        if options.sheet:
            check_suffix(options.out, PICTURE_SUFFIXES)
            sheet = _sheet(options, scene, progress)
            write_picture(options.out, to_uint8(sheet))
            return 0
        try:
            write_shards(
                options.out, count=options.count, seed=options.seed, size=options.size, device=options.device,
                scene=scene, batch=BATCH[options.device], progress=progress,
            )  # fmt: skip
        except KeyboardInterrupt:
            print(f"oasis: stopped; finished parts stay in {options.out}, the same command continues.", file=sys.stderr)
            return INTERRUPTED
    return 0


def _sheet(options: Synthesize, scene: SceneConfig, progress: Progress) -> torch.Tensor:
    """One picture of each of the first `count` people."""
    images = []
    for k in range(options.count):
        batch = render_batch(options.seed, [k * PICTURES_EACH], options.size, options.device, scene=scene)
        images.append(batch.image[0].cpu())
        progress("pictures", k + 1, options.count)
    return contact_sheet(torch.stack(images), min(SHEET_COLUMNS, options.count))
