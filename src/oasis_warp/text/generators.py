"""Where a picture of the described hand comes from: a file, a command, a pipeline or a hosted model of the user's."""

import inspect
import shlex
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from oasis_warp.core.errors import InputError, last_line, shortened
from oasis_warp.core.types import Photo
from oasis_warp.data.photo import read_photo

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
