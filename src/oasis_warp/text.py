"""Words to an avatar: what steers an image generator to a posed hand, generators, and the check of their pictures.

A generator is a file, a command, a pipeline or a hosted model; it is asked until a picture fits. It is steered by
depth, mask, normals, edges, and the pose itself.
"""

import inspect
import json
import shlex
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from oasis_warp.core import surface
from oasis_warp.core.camera import orbit_camera, project
from oasis_warp.core.errors import InputError, last_line, shortened
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.mirror import mirror_pixels, mirror_pose
from oasis_warp.core.types import Camera, HandPose, Photo, Side
from oasis_warp.data.photo import read_photo
from oasis_warp.data.pictures import to_uint8, write_picture
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.estimation.landmarks import box_size
from oasis_warp.hand.kinematics import HandKinematics
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.ops import depth_map

View = Literal["palm", "back"]

FINGERS_UP = {
    "palm": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "back": ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
}
"""Rotations from the hand's frame to the camera's."""
FOREARM, WIDENING = 0.3, 1.25
"""Length of the forearm below the wrist [m], beyond the picture's edge, and its girth there over that of the wrist."""
NEAREST, FARTHEST = 1.0, 0.3
"""Grey of the nearest and the farthest point of the hand; the background is 0."""
FACING = (0.5, 0.5, 1.0)
"""Colour of a normal towards the camera, as normal maps have it: x right, y up, z to the viewer."""
EDGES = (100, 200)
"""Canny's thresholds on 8 bits, the usual ones of ControlNet."""
Generator = Callable[[Path, str, int], Photo]
"""From the folder with the conditioning's files, the prompt and a seed to a picture."""

PLACES = ("{folder}", "{depth}", "{mask}", "{normal}", "{canny}", "{prompt}", "{seed}", "{out}")
"""What a command may name: the folder and its files, the words, the seed, and the picture to write."""


HOSTED, HOSTED_SECONDS = "hosted", 300.0
"""The word for a model of others' machines, and how long one may take."""
AS_DEPTH = "The given picture is its depth map, near is bright: keep the pose, the outline and the place of the hand."
"""Tells models that edit pictures what they are given."""


class Conditioning(NamedTuple):
    """A hand of mean shape in a pose, before a camera, and pictures of it that a generator follows."""

    side: Side
    pose: HandPose
    """In the camera's frame; a left hand's describes the mirrored model."""
    camera: Camera
    landmarks: Float[Tensor, "21 2"]
    """Where they are in the pictures [px]."""
    depth: Float[Tensor, "S S"]
    """Nearness: 1 is the nearest point of the hand, 0 the background. The forearm is in it."""
    mask: Float[Tensor, "S S"]
    """1 on hand and forearm."""
    normals: Float[Tensor, "S S 3"]
    """As colours."""


@torch.no_grad()
def make_conditioning(
    hand: HandModel, pose: str = "open", view: View = "palm", side: Side = "right", size: int = 1024
) -> Conditioning:
    """The mean hand with its fingers up, `size` pixels large, and a forearm that leaves the picture.

    Raises:
        ValueError: no such pose.
    """
    rest = rest_hand(hand, torch.zeros(hand.shape_basis.shape[-1]))
    placed = HandPose(named_pose(hand, pose), torch.tensor(FINGERS_UP[view]), torch.zeros(3))
    posed = skin(hand, rest, placed)
    camera = orbit_camera(posed.vertices, 0.0, size=size)
    forward = camera.viewmat[:3, 3]
    camera, placed = camera._replace(viewmat=torch.eye(4)), placed._replace(translation=forward)
    vertices = posed.vertices + forward
    landmarks = project(camera, _landmarks(hand, placed))[0]
    pictures = _pictures(hand, vertices, placed.orientation[:, 0], camera)
    if side == "left":
        placed, landmarks = mirror_pose(placed), mirror_pixels(landmarks, size)
        depth, mask, normals = (picture.flip(1) for picture in pictures)
        normals[..., 0] = 1 - normals[..., 0]  # to the other side, as the picture
        pictures = depth, mask, normals
    return Conditioning(side, placed, camera, landmarks, *pictures)


def _landmarks(hand: HandModel, pose: HandPose) -> Float[Tensor, "21 3"]:
    """The points that a landmark network finds, in the camera's frame [m]."""
    kinematics = HandKinematics(hand)
    table = np.concatenate([np.zeros((1, 3)), pose.angles.double().numpy()])
    joints = kinematics.pose_all_joints(table, np.zeros(hand.shape_basis.shape[-1]))
    points = torch.from_numpy(kinematics.landmarks(joints)[0]).float()
    return points @ pose.orientation.T + pose.translation


def _pictures(hand: HandModel, vertices: Tensor, outwards: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Depth, mask and normals of the hand with a forearm that grows from its rim along `outwards`."""
    rim = hand.rim
    ring = vertices[rim]
    far = ring.mean(0) + (ring - ring.mean(0)) * WIDENING + FOREARM * outwards
    n, k = len(vertices), torch.arange(len(rim))
    following = k.roll(-1)
    tube = torch.cat(
        [torch.stack([rim[k], n + k, rim[following]], 1), torch.stack([n + k, n + following, rim[following]], 1)]
    )
    whole, faces = torch.cat([vertices, far]), torch.cat([hand.faces, tube.to(hand.faces)])
    seen = depth_map(whole, faces, camera.viewmat, camera.K, camera.width, camera.height)
    mask = (seen.face_ids >= 0).float()
    near, deep = (float(bound) for bound in vertices[:, 2].aminmax())
    depth = NEAREST - (seen.depth - near) / (deep - near) * (NEAREST - FARTHEST)
    normals = surface.vertex_normals(whole, faces)
    corners = normals[faces[seen.face_ids.clamp_min(0).long()].long()]
    facing = torch.nn.functional.normalize((corners * seen.barycentrics[..., None]).sum(-2), dim=-1)
    facing = torch.where(facing[..., 2:] > 0, -facing, facing)  # the rim's winding does not matter
    colors = (1 + facing * torch.tensor([1.0, -1.0, -1.0])) / 2
    return (
        depth.clamp(0, 1) * mask,
        mask,
        torch.where(mask[..., None] > 0, colors, torch.tensor(FACING)),
    )


def write_conditioning(folder: Path, conditioning: Conditioning) -> None:
    """Write depth.png, mask.png, normal.png, canny.png and pose.json into `folder`.

    Raises:
        InputError: they cannot be written.
    """
    grey = [to_uint8(part[..., None].expand(-1, -1, 3)) for part in (conditioning.depth, conditioning.mask)]
    normals = to_uint8(conditioning.normals)
    edges = cv2.Canny(normals.numpy(), *EDGES)
    pictures = {
        "depth": grey[0], "mask": grey[1], "normal": normals,
        "canny": torch.from_numpy(np.repeat(edges[..., None], 3, 2)),
    }  # fmt: skip
    for name, picture in pictures.items():
        write_picture(folder / f"{name}.png", picture)
    (folder / "pose.json").write_text(json.dumps(keypoints(conditioning, conditioning.camera.width), indent=1))


def keypoints(conditioning: Conditioning, size: int) -> dict[str, object]:
    """The pose and camera as a file for `--keypoints`, for a picture of `size` pixels."""
    pose, K = conditioning.pose, conditioning.camera.K * (size / conditioning.camera.width)
    return {
        "side": conditioning.side,
        "angles": pose.angles.tolist(),
        "orientation": pose.orientation.tolist(),
        "translation": pose.translation.tolist(),
        "focal": float(K[0, 0]),
        "centre": K[:2, 2].tolist(),
    }


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
    """A hosted image-to-image model, run by Hugging Face or one of its providers; depth and words are sent there.

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
    """`word` with its placeholders replaced, from first to last; what was filled in is not searched again."""
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
        generator: Generator of the pictures.
        estimator: Finds the hand in them.
        conditioning: What was asked for.
        folder: With the conditioning's files.
        prompt: The words.
        seed: Seed of the first picture.
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
    """Distance of the landmarks from those asked for [%], or a message why this is another hand."""
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
