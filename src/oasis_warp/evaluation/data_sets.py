"""Evaluate avatars on data sets: made of one picture of a person, drawn in the pose and camera of the others.

A data set has many pictures of few people, each with the hand that its annotations tell. Some pictures of each person
become avatars, evenly spaced over all, and for each of them others are compared with, evenly spaced too.
"""

import hashlib
import json
import math
import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, get_args, runtime_checkable

import torch
from torch import Tensor

from oasis_warp import __version__
from oasis_warp.avatar.prior import Prior
from oasis_warp.core.config import BLACK, AdaptConfig, ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.logging import Progress, silent
from oasis_warp.core.types import Camera, HandCrop, HandFit, HandPose, Landmarks, Photo, Side
from oasis_warp.data.output_files import open_resumable_folder, write_file
from oasis_warp.datasets.readers import PAPER, DatasetName, read_dataset, read_selection
from oasis_warp.datasets.samples import Catalogue, Models, load_picture
from oasis_warp.datasets.training_source import in_camera
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.estimation.hand_crop import crop_hand, initial_offsets
from oasis_warp.estimation.keypoints import fit_of_pose
from oasis_warp.estimation.outline import wrist_line
from oasis_warp.evaluation.methods import Method, prior_digest, reconstructions
from oasis_warp.evaluation.metrics import TargetTruth, score
from oasis_warp.evaluation.pictures import ATTENTION_COLUMNS, tile, write_attention, write_sheet, write_strip
from oasis_warp.evaluation.summary import Record, mean
from oasis_warp.fitted_avatar import make_avatar
from oasis_warp.hand.mano import read_mano
from oasis_warp.hand.template import MANO_DIR, chosen_hand
from oasis_warp.hand_avatar import Avatar
from oasis_warp.losses import Perceptual

SETTINGS, METRICS, SHEET, AVATARS = "evaluation.json", "metrics.json", "sheet.png", "avatars"
"""Files that an evaluation writes; the last is a folder with the results of each avatar."""
ATTENTION, ATTENTION_END = "attention.png", "_attention.png"
"""What the network attends to in the photos, and the end of the file's name for one of them."""
MEASURES = ("psnr", "psnr_whole", "ssim", "ssim_box", "ssim_mask", "lpips")
DIGITS = 5
WARM, FRAMES, LONGEST = 2, 20, 0.5
"""Frames that are drawn before the clock starts; the most that are timed, and after how long no more begin [s]."""
ERROR_STREAM = 7
"""Stream of the random numbers of wrong poses."""


class Key(NamedTuple):
    """The name of a picture in a data set."""

    subject: str
    name: str
    """Name of the picture; no other has it."""

    @property
    def file(self) -> str:
        """What its files are called: as the picture, or with a digest of its name where that is no name of a file."""
        plain = re.sub(r"[^\w.-]+", "-", self.name)
        return plain if plain == self.name else f"{plain}-{hashlib.sha256(self.name.encode()).hexdigest()[:8]}"


class Sample(NamedTuple):
    """One picture with one hand, as the data set cuts it out for evaluation."""

    photo: Photo
    """With the data set's own mask as alpha, where it has one, and its focal length."""
    hand: Landmarks | HandFit
    """21 annotated points, which our hand is fitted to, or the annotated pose of it."""


@runtime_checkable
class DataSet(Protocol):
    """What an evaluation needs of a data set."""

    @property
    def keys(self) -> Sequence[Key]:
        """All pictures that are evaluated, in the order of the recording."""
        ...

    @property
    def left_out(self) -> Mapping[str, str]:
        """Pictures that are not among them, by name, and why in words."""
        ...

    def read(self, key: Key) -> Sample:
        """One of them.

        Raises:
            InputError: it is missing or broken.
        """
        ...


class Row(NamedTuple):
    """A way to make avatars, a row of a table."""

    name: str
    prior: str
    """Name among the priors."""
    stage: str
    """One of `methods.STAGES`."""
    adapt: AdaptConfig
    pose_error: float = 0.0
    """Standard deviation of errors that joint angles and the hand's orientation are given [degrees]."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Choice of the pictures that are evaluated."""

    photos: int = 16
    """Photos of each person that avatars are made of."""
    targets: int = 4
    """Pictures that each avatar is compared with; the photo itself where a person has no other."""
    seed: int = 0
    """Seed of wrong poses."""


def evenly(items: Sequence[Any], count: int) -> list[Any]:
    """At most `count` of `items`, from the first to the last."""
    n = min(count, len(items))
    return [items[round(k * (len(items) - 1) / max(n - 1, 1))] for k in range(n)]


def choose(keys: Sequence[Key], choice: Choice) -> list[tuple[Key, list[Key]]]:
    """The photos that avatars are made of, and with what each is compared."""
    chosen = []
    for subject in dict.fromkeys(key.subject for key in keys):
        own = [key for key in keys if key.subject == subject]
        for photo in evenly(own, choice.photos):
            others = [key for key in own if key != photo]
            chosen.append((photo, evenly(others, choice.targets) or [photo]))
    return chosen


def evaluate_data_set(
    data: DataSet, priors: Mapping[str, Prior], rows: Sequence[Row], choice: Choice, out: Path, *,
    config: ReconstructConfig = ReconstructConfig(),  # noqa: B008 - frozen
    perceptual: Perceptual | None = None, progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """Make avatars of every row, compare them with other pictures of the person, and return the contents of METRICS.

    An interrupted run goes on with the avatars that are missing. Pictures that cannot be read or that no pose fits are
    left out and named in METRICS.

    Args:
        data: The data set.
        priors: By the names that rows have for them.
        rows: Ways to make avatars.
        choice: Which pictures are looked at.
        out: Output folder.
        config: Its device and hand model are used; poses that the data set knows are of that model.
        perceptual: LPIPS, if its weights are available.
        progress: Called for each photo.

    Raises:
        InputError: a folder that cannot be used, or no picture that an avatar could be made of.
    """
    config = ReconstructConfig(hand_model=config.hand_model, mano_dir=config.mano_dir, device=config.device)
    settings = {
        "version": __version__, "priors": {name: prior_digest(prior) for name, prior in priors.items()},
        "lpips": perceptual is not None, "hand_model": config.hand_model, **asdict(choice),
        "rows": [{**row._asdict(), "adapt": asdict(row.adapt)} for row in rows],
    }  # fmt: skip
    open_resumable_folder(out, SETTINGS, settings, "an evaluation")
    (out / AVATARS).mkdir(exist_ok=True)
    chosen = choose(data.keys, choice)
    measuring = _Measuring(data, priors, rows, choice, config, perceptual)
    for k, (photo, targets) in enumerate(chosen):
        progress("evaluation", k, len(chosen))
        if not (out / AVATARS / f"{photo.file}.json").exists():
            measuring.measure(photo, targets, out / AVATARS)
    progress("evaluation", len(chosen), len(chosen))
    found = [json.loads((out / AVATARS / f"{photo.file}.json").read_text()) for photo, _ in chosen]
    pictures = [picture for one in found for picture in one["pictures"]]
    left_out = {**data.left_out, **{name: why for one in found for name, why in one["left_out"].items()}}
    if not pictures:
        first = next(iter(left_out.values()), "it has no pictures")
        raise InputError(f"{out}: no avatar could be made from any picture of the data set: {first}")
    strips = [path for photo, _ in chosen if (path := out / AVATARS / f"{photo.file}.png").exists()]
    write_sheet(out / SHEET, strips, ["photo", "truth", *(row.name for row in rows)])
    maps = [path for photo, _ in chosen if (path := out / AVATARS / f"{photo.file}{ATTENTION_END}").exists()]
    if maps:
        write_sheet(out / ATTENTION, maps, ATTENTION_COLUMNS)
    whole = {"settings": settings, "summary": summarise(pictures), "left_out": left_out, "pictures": pictures}
    write_file(out / METRICS, json.dumps(whole, allow_nan=False).encode())
    return whole


def summarise(pictures: Sequence[Record]) -> list[Record]:
    """A row for each way to make avatars: means over pictures, of times over avatars."""
    summary = []
    for name in dict.fromkeys(picture["row"] for picture in pictures):
        own = [picture for picture in pictures if picture["row"] == name]
        avatars = list({picture["photo"]: picture for picture in own}.values())
        summary.append({
            "row": name, "avatars": len(avatars), "pictures": len(own), **{key: mean(own, key) for key in MEASURES},
            "seconds": mean(avatars, "seconds"), "fps": mean(avatars, "fps"),
        })  # fmt: skip
    return summary


class Crop(NamedTuple):
    """A photo's hand, ready for reconstruction."""

    fit: HandFit
    offsets: Tensor
    """Offsets of the rest surface [V, 3]."""
    hand: HandCrop


class _Measuring(NamedTuple):
    """Shared inputs of all measurements of avatars."""

    data: DataSet
    priors: Mapping[str, Prior]
    rows: Sequence[Row]
    choice: Choice
    config: ReconstructConfig
    perceptual: Perceptual | None

    @property
    def hand(self) -> HandModel:
        return chosen_hand(self.config.hand_model, self.config.mano_dir)

    @torch.no_grad()
    def measure(self, photo: Key, targets: Sequence[Key], folder: Path) -> None:
        """Write the pictures of one photo's avatars, then their records."""
        estimator, pictures, left_out = HandEstimator(self.hand), [], {}
        strip: list[list[Tensor]] = []
        try:
            source = self.data.read(photo)
            fit = fitted(estimator, source)
            truths = {}
            for target in targets:
                try:
                    truths[target] = target_truth(estimator, self.data.read(target), fit, self.config.device)
                except InputError as error:
                    left_out[target.name] = str(error)
            drawn = {target: [source.photo.rgb / 255, truth.image] for target, (truth, _, _) in truths.items()}
            crops: dict[float, Crop] = {}
            for row in self.rows:
                if row.pose_error not in crops:
                    crops[row.pose_error] = self.crop(source.photo, fit, row.pose_error)
                avatar, seconds = self.make(row, crops[row.pose_error])
                for target, (truth, camera, pose) in truths.items():
                    image = avatar.render(camera, pose, BLACK).image
                    drawn[target].append(image)
                    about = {"row": row.name, "photo": photo.name, "target": target.name, "seconds": seconds}
                    pictures.append({**about, "fps": None, **_measured(image, truth, self.perceptual)})
                if truths:
                    pictures[-1]["fps"] = frames_per_second(avatar)
            strip = [[tile(image) for image in images] for images in list(drawn.values())[:1]]
            write_attention(folder / f"{photo.file}{ATTENTION_END}", self.priors, next(iter(crops.values())).hand)
        except InputError as error:
            left_out[photo.name] = str(error)
        if strip:
            write_strip(folder / f"{photo.file}.png", strip)
        found = {"pictures": pictures, "left_out": left_out}
        write_file(folder / f"{photo.file}.json", json.dumps(found, allow_nan=False).encode())

    def crop(self, photo: Photo, fit: HandFit, pose_error: float) -> Crop:
        """What rows with one error of the pose share."""
        fit = misposed(self.hand, fit, pose_error, self.choice.seed)
        offsets = initial_offsets(self.hand, fit)
        return Crop(fit, offsets, crop_hand(photo, fit, offsets, self.config))

    @torch.enable_grad()
    def make(self, row: Row, cropped: Crop) -> tuple[Avatar, float]:
        """One avatar and how long the guess and its adaptation took [s]."""
        hand, (fit, offsets, crop) = self.hand, cropped
        start = time.perf_counter()
        methods = [Method(row.prior, row.stage)]
        learned = None if row.adapt.texture == "field" else self.perceptual
        ((_, made),) = reconstructions(hand, crop, {row.prior: self.priors[row.prior]}, methods, row.adapt, learned)
        _wait(self.config.device)
        seconds = time.perf_counter() - start
        return make_avatar(fit, offsets, crop, made.gaussians, made.light, hand=hand), round(seconds, 2)


def fitted(estimator: HandEstimator, sample: Sample, shape: Tensor | None = None) -> HandFit:
    """The hand of a sample by our model, with the shape of another picture of the person where it is given."""
    if isinstance(sample.hand, HandFit):
        return sample.hand if shape is None else sample.hand._replace(shape=shape)
    return estimator.fit(sample.photo, sample.hand, shape=shape, force=True)


def misposed(hand: HandModel, fit: HandFit, degrees: float, seed: int) -> HandFit:
    """The fit with errors of joint angles, within the limits of joints, and of the orientation; the same every time."""
    if not degrees:
        return fit
    random = torch.Generator().manual_seed(seed * 1000 + ERROR_STREAM)
    errors = math.radians(degrees) * torch.randn(16, 3, generator=random)
    low, high = hand.pose_limits[1:].unbind(-1)
    angles = torch.minimum(torch.maximum(fit.pose.angles + errors[1:], low), high)
    rotation = torch.linalg.matrix_exp(torch.cross(torch.eye(3), errors[0].expand(3, 3), dim=-1))
    return fit._replace(pose=fit.pose._replace(angles=angles, orientation=fit.pose.orientation @ rotation))


def target_truth(
    estimator: HandEstimator, sample: Sample, source: HandFit, device: str
) -> tuple[TargetTruth, Camera, HandPose]:
    """What the whole picture must look like, its camera, and the hand's pose in it.

    Raises:
        InputError: another side than the photo's, or a hand that cannot be fitted.
    """
    fit = fitted(estimator, sample, source.shape)
    if fit.side != source.side:
        raise InputError(f"{sample.photo.name}: shows a {fit.side} hand, the photo a {source.side} one; left out.")
    camera = fit.camera._replace(viewmat=fit.camera.viewmat.to(device), K=fit.camera.K.to(device))
    above = wrist_line(fit.landmarks.xy.numpy()).above_mask((camera.width, camera.height))
    known = torch.from_numpy(above).to(device, torch.float32)
    mask, nowhere = fit.mask.to(device) * known, torch.zeros_like(known, dtype=torch.bool)
    image = sample.photo.rgb.to(device) / 255 * mask[..., None]
    return TargetTruth(image, mask, known, nowhere, nowhere, nowhere, nowhere), camera, fit.pose


def _measured(image: Tensor, truth: TargetTruth, perceptual: Perceptual | None) -> Record:
    found = score(image, truth, perceptual)
    error = float((image.clamp(0, 1) * truth.known[..., None] - truth.image).square().mean())
    found["psnr_whole"] = -10 * math.log10(max(error, 1e-12))
    return {name: None if (value := found[name]) is None else round(value, DIGITS) for name in MEASURES}


@torch.no_grad()
def frames_per_second(avatar: Avatar) -> float:
    """Frames a second of posing and drawing, in the photo's camera."""
    device, frames = avatar.device.type, 0
    for _ in range(WARM):
        avatar.render(avatar.source_camera, avatar.source_pose)
    _wait(device)
    start = time.perf_counter()
    while frames < FRAMES and time.perf_counter() - start < LONGEST:
        avatar.render(avatar.source_camera, avatar.source_pose)
        frames += 1
    _wait(device)
    return round(frames / (time.perf_counter() - start), 2)


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


class CatalogueData:
    """The samples of a catalogue as a `DataSet`, all as right hands of MANO."""

    def __init__(self, found: Catalogue, models: Models, config: ReconstructConfig, size: int):
        self.keys = [Key(sample.subject, sample.name) for sample in found.samples]
        self.left_out = found.left_out
        self._samples = {sample.name: sample for sample in found.samples}
        self._models, self._size = models, size
        self._hand = chosen_hand(config.hand_model, config.mano_dir)

    @classmethod
    def open(
        cls, name: DatasetName, root: Path, config: ReconstructConfig, size: int, selection: Path | None = None
    ) -> "CatalogueData":
        """What the paper evaluates on, of the data set below `root`; of InterHand2.6M what a file selects.

        Raises:
            InputError: no such folder, no file of MANO, or not one sample.
        """
        chosen_hand(config.hand_model, config.mano_dir)  # says what is missing
        folder = Path(config.mano_dir or os.environ[MANO_DIR])
        models: Models = {side: read_mano(folder, side) for side in get_args(Side)}
        chosen = PAPER if selection is None else read_selection(selection)
        return cls(read_dataset(name, root, folder, "test", chosen), models, config, size)

    def read(self, key: Key) -> Sample:
        """The square around the hand, and the annotated pose.

        Raises:
            InputError: the photo or its mask is missing or broken, or its box is too small.
        """
        picture = load_picture(self._samples[key.name], self._models, self._size)
        K = picture.camera.K.float()
        rgb = (255 * picture.image).round().to(torch.uint8)
        photo = Photo(rgb, picture.mask, float(K[0, 0]), key.name, 1.0)
        pose = HandPose(*(part.float() for part in in_camera(self._hand, picture.mano, picture.camera.viewmat)))
        camera = Camera(torch.eye(4), K, self._size, self._size)
        return Sample(photo, fit_of_pose(self._hand, photo, "right", picture.mano.betas, pose, camera))
