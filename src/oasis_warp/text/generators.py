"""Pictures of the described hand: a file, a command, a pipeline or a hosted model; and asking until one fits."""

import inspect
import shlex
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from oasis_warp.core.errors import InputError, last_line, shortened
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import Photo
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.text.conditioning import Conditioning

Generator = Callable[[Path, str, int], Photo]
"""From the folder with the conditioning's files, the prompt and a seed to a picture."""

PLACES = ("{folder}", "{depth}", "{mask}", "{normal}", "{canny}", "{prompt}", "{seed}", "{out}")
"""What a command may name: the folder and its files, the words, the seed, and the picture to write."""


HOSTED, HOSTED_SECONDS = "hosted", 300.0
"""The word for a model of others' machines, and how long one may take."""
AS_DEPTH = "The given picture is its depth map, near is bright: keep the pose, the outline and the place of the hand."
"""Tells models that edit pictures what they are given."""


def choose_generator(given: str) -> Generator:
    """A picture's file, a folder with a diffusers pipeline, a command with {out} in it, or "hosted" or "hosted:MODEL".

    Raises:
        InputError: it is none of these.
    """
    service, _, model = given.partition(":")
    if service == HOSTED:
        return _hosted(model or None)
    path = Path(given)
    if path.is_file():
        return lambda folder, prompt, seed: read_photo(path)
    if path.is_dir():
        return _pipeline(path)
    if "{out}" in given:
        return _command(given)
    raise InputError(
        f"--generator {given}: expected a picture, a folder with a diffusers pipeline, hosted:MODEL, or a command "
        f"with {{out}} in it, such as 'paint --depth {{depth}} --prompt {{prompt}} -o {{out}}'; give one of these."
    )


def _hosted(model: str | None) -> Generator:
    """An image-to-image model that Hugging Face or one of its providers runs; depth and words are sent there.

    `model` is its name, or the address of an endpoint; None for the one that the service recommends.
    """
    name = HOSTED if model is None else f"{HOSTED}:{model}"
    try:
        import huggingface_hub
    except ImportError as error:
        raise InputError(
            f"--generator {name}: a hosted model needs its client; run pip install 'oasis-warp[hosted]'."
        ) from error
    token = huggingface_hub.get_token()
    if token is None:
        raise InputError(f"--generator {name}: needs a token of huggingface.co; put it into HF_TOKEN.")
    client = huggingface_hub.InferenceClient(model=model, token=token, timeout=HOSTED_SECONDS)

    def generate(folder: Path, prompt: str, seed: int) -> Photo:
        steer, words = (folder / "depth.png").read_bytes(), f"{prompt}. {AS_DEPTH}"
        try:
            picture = client.image_to_image(steer, prompt=words, seed=seed)
        except Exception as error:  # its HTTP library changes with its version, and each provider has errors of its own
            raise InputError(
                f"--generator {name}: no picture came ({shortened(str(error))}); try another model, or later."
            ) from error
        return _as_photo(picture, seed)

    return generate


def _as_photo(picture: Any, seed: int) -> Photo:
    """A picture of Pillow."""
    return Photo(torch.from_numpy(np.array(picture.convert("RGB"))), None, None, f"picture with seed {seed}", 1.0)


def _command(line: str) -> Generator:
    """Runs `line` without a shell; every word may hold several of `PLACES`."""
    try:
        words = shlex.split(line)
    except ValueError as error:
        raise InputError(f"--generator {line}: cannot be read as a command ({error}); check its quotes.") from error

    def generate(folder: Path, prompt: str, seed: int) -> Photo:
        with tempfile.TemporaryDirectory() as made:
            out = Path(made) / "picture.png"
            files = [str(folder), *(str(folder / f"{name}.png") for name in ("depth", "mask", "normal", "canny"))]
            values = dict(zip(PLACES, [*files, prompt, str(seed), str(out)], strict=True))
            try:
                filled = [_filled(word, values) for word in words]
                ran = subprocess.run(filled, capture_output=True, text=True, check=False)
            except OSError as error:
                raise InputError(
                    f"--generator {words[0]}: cannot be started ({error.strerror}); check its name."
                ) from error
            if ran.returncode or not out.is_file():
                failure = f"exit code {ran.returncode}: {last_line(ran.stderr)}"
                raise InputError(f"--generator {words[0]}: wrote no picture ({failure}); run it alone.")
            return read_photo(out)

    return generate


def _filled(word: str, values: dict[str, str]) -> str:
    """`word` with the first of the places replaced, then the rest: what was put in is not read again."""
    for place, value in values.items():
        before, found, after = word.partition(place)
        if found:
            return _filled(before, values) + value + _filled(after, values)
    return word


def _pipeline(folder: Path) -> Generator:
    """A text-to-image ControlNet pipeline of `diffusers`, read from `folder`; nothing is downloaded or unpickled."""
    try:
        import diffusers
    except ImportError as error:
        raise InputError(
            f"--generator {folder}: a diffusers pipeline needs that package; run pip install 'oasis-warp[text]'."
        ) from error
    try:
        pipeline = diffusers.DiffusionPipeline.from_pretrained(folder, local_files_only=True, use_safetensors=True)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"--generator {folder}: expected a diffusers pipeline ({error}); save one there.") from error
    named = inspect.signature(pipeline.__call__).parameters
    depth = next((name for name in ("control_image", "image") if name in named), None)
    if depth is None:
        raise InputError(
            f"--generator {folder}: {type(pipeline).__name__} takes no depth picture; save a ControlNet pipeline there."
        )
    if torch.cuda.is_available():
        pipeline.to("cuda")
    pipeline.set_progress_bar_config(disable=True)

    def generate(conditioning: Path, prompt: str, seed: int) -> Photo:
        from PIL import Image

        steer = Image.open(conditioning / "depth.png").convert("RGB")
        random = torch.Generator().manual_seed(seed)
        made = pipeline(prompt=prompt, width=steer.width, height=steer.height, generator=random, **{depth: steer})
        return _as_photo(made.images[0], seed)

    return generate


MAX_OFF = 6.0
"""Largest mean distance of the landmarks found from those asked for [% of the longer side of their box]. Neighbouring
knuckles of an open hand are some 12 % apart: from half of that on, a finger may stand in its neighbour's place."""
SQUARE = 0.02
"""Share by which a picture's sides may differ."""


class Imagined(NamedTuple):
    """A picture that shows the hand that was asked for."""

    photo: Photo
    seed: int
    distance: float
    """Mean distance of its landmarks from those asked for [% of the longer side of their box]."""


def imagine(
    generator: Generator, estimator: HandEstimator, conditioning: Conditioning, folder: Path, prompt: str, *,
    seed: int = 0, tries: int = 4, progress: Progress = silent,
) -> Imagined:  # fmt: skip
    """The first picture with this hand in this pose, of the seeds `seed`, `seed` + 1, ...

    Args:
        generator: Of the pictures.
        estimator: Finds the hand in them.
        conditioning: What was asked for.
        folder: With the conditioning's files.
        prompt: The words.
        seed: Of the first picture.
        tries: Number of pictures to ask for.
        progress: Called for every picture.

    Raises:
        InputError: no picture shows that hand; the sentence says what each shows. Or the generator fails.
    """
    reasons = []
    for k in range(tries):
        progress("pictures", k, tries)
        photo = generator(folder, prompt, seed + k)
        found = _distance(estimator, conditioning, photo)
        if isinstance(found, float):
            progress("pictures", tries, tries)
            return Imagined(photo, seed + k, found)
        reasons.append(f"seed {seed + k}: {found}")
    raise InputError(
        f"no picture shows a {conditioning.side} hand in the pose asked for ({'; '.join(reasons)}); "
        "try other words or another --seed, or give the generator's depth more weight."
    )


def _distance(estimator: HandEstimator, conditioning: Conditioning, photo: Photo) -> float | str:
    """How far the landmarks are off [%], or in words why this is not the hand asked for."""
    height, width = photo.rgb.shape[:2]
    if abs(height - width) > SQUARE * width:
        return f"{width} x {height} pixels instead of a square"
    asked = conditioning.landmarks * (width / conditioning.camera.width)
    size = box_size(asked.numpy())
    hands = [hand for hand in estimator.find(photo) if hand.side == conditioning.side]
    if not hands:
        return f"no {conditioning.side} hand found"
    off = min(float((hand.xy - asked).norm(dim=-1).mean()) for hand in hands) / size * 100
    return off if off <= MAX_OFF else f"the landmarks are {off:.0f} % of the hand's size off"
