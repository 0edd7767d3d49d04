"""The file trees of published data sets -> `Catalogue`. Each reader names the files that it expects."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from oasis_warp.core.errors import InputError, shortened
from oasis_warp.core.pickle_reader import read_pickle
from oasis_warp.core.types import Side
from oasis_warp.data.json_text import whole
from oasis_warp.datasets.samples import Catalogue, File, Models, Sample, Tree, entry, numbers, pose_of_48, read_table
from oasis_warp.estimation.mano_estimates import SUFFIXES, Estimate, estimate_of_entries, read_estimate
from oasis_warp.hand.mano import mano_surface, mirror_mano_pose, read_mano, subsample

DatasetName = Literal["interhand", "hanco", "freihand", "ho3d", "coco-hand", "whim", "photos"]
Split = Literal["train", "val", "test"]
MAX_CAPTURES = 1000
PAPER_CAPTURES = frozenset({0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 20, 22, 23, 24, 25})
"""Captures of InterHand2.6M's training set that the paper trains on (appendix C)."""
EXCLUDED_SEQUENCES = frozenset({
    "0000_neutral_relaxed", "0009_thumbtucknormal", "0019_alligator_closed", "0029_indextip",
    "0039_fingerspreadrigid", "0048_index_point", "0058_middlefinger",
})  # fmt: skip
"""Sequences that the paper leaves out of them."""


class Selection(NamedTuple):
    """What is taken of InterHand2.6M; the paper's choice, as far as it tells."""

    captures: frozenset[int] = PAPER_CAPTURES
    """Captures of the training set."""
    excluded: frozenset[str] = EXCLUDED_SEQUENCES
    """Sequences of these captures that are not taken."""
    test_captures: frozenset[int] = frozenset({0})
    """Captures of the test set."""
    test_sequences: frozenset[str] = frozenset({"ROM03_RT_No_Occlusion"})
    """Sequences of these captures."""
    test_step: int = 1
    """Every so many of their frames is taken. The paper has "fixed skip steps" and does not say which."""

    def takes(self, split: Split, capture: int, sequence: str) -> bool:
        """Whether a sequence is among them; the validation set is, all of it."""
        if split == "test":
            return capture in self.test_captures and sequence in self.test_sequences
        return split != "train" or (capture in self.captures and sequence not in self.excluded)


PAPER = Selection()


def read_selection(path: Path) -> Selection:
    """A selection from a JSON file with some of the fields of `Selection`; the others are the paper's.

    Raises:
        InputError: no JSON, an unknown field, or other values than lists of numbers or names.
    """
    kinds = {"captures": int, "test_captures": int, "excluded": str, "test_sequences": str}
    found = read_table(File(path))
    if not isinstance(found, dict) or (unknown := sorted(found.keys() - set(Selection._fields))):
        got = "no object" if not isinstance(found, dict) else shortened(unknown[0])
        raise InputError(f"{path}: expected some of {', '.join(Selection._fields)}, got {got}; leave it out.")
    step = found.pop("test_step", 1)
    if not whole(step, 1, 1 << 20):
        raise InputError(f"{path}: test_step: expected a whole number from 1 on, got {shortened(repr(step))}.")
    for name, values in found.items():
        if not isinstance(values, list) or not all(type(value) is kinds[name] for value in values):
            raise InputError(f"{path}: {name}: expected a list of {'numbers' if kinds[name] is int else 'names'}.")
    return Selection(**{name: frozenset(values) for name, values in found.items()}, test_step=step)


HANCO_SEQUENCE, HANCO_CAMERAS = 154, (0, 3, 5, 6, 7)
"""Sequence and cameras of HanCo that the paper evaluates on."""
PICTURES = (".jpg", ".jpeg", ".png", ".webp")
_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_ANCHOR = 4
"""MANO's first joint of the middle finger, landmark 9, which FreiHAND's root is."""


def read_dataset(
    name: DatasetName, root: Path, mano_dir: Path, split: Split = "train", selection: Selection = PAPER
) -> Catalogue:
    """The samples of a data set below `root`, as the paper takes them.

    Args:
        name: Name of the data set.
        root: Its folder. What lies in *.tar files directly in it counts as unpacked there.
        mano_dir: With MANO's files.
        split: Split of the data set.
        selection: What is taken of InterHand2.6M.

    Raises:
        InputError: no such folder or annotation file, or not one sample in it.
    """
    if not root.is_dir():
        raise InputError(f"{root}: expected the folder of {name}, found none; give --root.")
    # A twentieth of the vertices tells whether a camera sees a hand; joints come from all of them.
    models: Models = {side: subsample(read_mano(mano_dir, side)) for side in get_args(Side)}
    tree = Tree(root)
    found = _interhand(tree, models, split, selection) if name == "interhand" else _READERS[name](tree, models, split)
    found.left_out |= tree.left_out
    if not found.samples:
        reason = next(iter(found.left_out.values()), "there are no photos where it keeps them.")
        raise InputError(f"{root}: found no sample of {name} in it: {reason}")
    return found


def _interhand(tree: Tree, models: Models, split: Split, selection: Selection) -> Catalogue:
    """annotations/SPLIT/InterHand2.6M_SPLIT_{data,camera,MANO_NeuralAnnot}.json, images/SPLIT/...; millimetres."""
    data, cameras, mano = (
        read_table(tree.file(f"annotations/{split}/InterHand2.6M_{split}_{part}.json"))
        for part in ("data", "camera", "MANO_NeuralAnnot")
    )
    found, frames = Catalogue(), dict[tuple[int, str, int], int]()
    images = {}
    for image in _rows(tree, data, "images"):
        with found.reading(f"{split}/{image.get('file_name') if isinstance(image, dict) else '?'}"):
            images[image["id"]] = image
    for annotation in _rows(tree, data, "annotations"):
        number = annotation.get("image_id") if isinstance(annotation, dict) else None
        image = images.get(number) if isinstance(number, int | str) else None
        name = f"{split}/{image['file_name']}" if image and "file_name" in image else f"annotation of {split}"
        with found.reading(name):
            if image is None:
                raise InputError(f"{name}: names a photo that is not listed.")
            capture, sequence = int(image["capture"]), image["seq_name"]
            if not 0 <= capture < MAX_CAPTURES:
                raise InputError(f"{name}: its capture is {shortened(str(capture))}.")
            if not selection.takes(split, capture, sequence) or annotation["hand_type"] not in models:
                continue
            order = frames.setdefault((capture, sequence, image["frame_idx"]), len(frames))
            if split == "test" and order % selection.test_step:
                continue
            side: Side = annotation["hand_type"]
            values = entry(mano, capture, image["frame_idx"], side, what="MANO parameters of")
            if values is None:
                raise InputError(f"{name}: has no MANO parameters of the {side} hand.")
            place, rotation, focal, middle = _camera(cameras, capture, str(image["camera"]))
            pose = pose_of_48(models[side], values["pose"], values["shape"], values["trans"], with_mean=False)
            box = numbers(annotation["bbox"], 4, what="bbox")
            sample = Sample(
                f"{name} {side}", tree.file(f"images/{name}"), None, side, f"{split}/Capture{capture}",
                _view(rotation, -rotation @ place / 1000), _intrinsics(*focal, *middle), pose, box,
            )  # fmt: skip
            found.add(sample, models)
    return found


def _rows(tree: Tree, data: Any, key: str) -> list[Any]:
    """InterHand's list of photos or of hands."""
    rows = data.get(key) if isinstance(data, dict) else None
    if not isinstance(rows, list):
        raise InputError(f"{tree.root}: InterHand2.6M_*_data.json has no list of {key}; download it again.")
    return rows


def _camera(cameras: Any, capture: int, number: str) -> list[np.ndarray]:
    """InterHand's place [mm], rotation, focal lengths and principal point [px]."""
    return [
        numbers(entry(cameras, capture, part, number, what="camera"), *shape, what=part)
        for part, shape in (("campos", (3,)), ("camrot", (3, 3)), ("focal", (2,)), ("princpt", (2,)))
    ]


def _hanco(tree: Tree, models: Models, split: Split) -> Catalogue:
    """rgb/SSSS/camC/F.jpg, mask_hand beside rgb, calib/SSSS/F.json (K, M), shape/SSSS/F.json; all right hands."""
    found, model = Catalogue(), models["right"]
    for name in tree.names(f"rgb/{HANCO_SEQUENCE:04d}" if split == "test" else "rgb"):
        parts = re.fullmatch(r"rgb/(\d+)/cam(\d+)/([^/]+)\.jpg", name)
        if parts is None:
            continue
        sequence, camera, frame = parts[1], int(parts[2]), f"{parts[1]}/{parts[3]}.json"
        if split == "test" and camera not in HANCO_CAMERAS:
            continue
        with found.reading(name):
            calibration, values = (read_table(tree.file(f"{part}/{frame}")) for part in ("calib", "shape"))
            if isinstance(values, list):  # shapes, poses, place in one row
                values = {"shapes": values[:10], "poses": values[10:58], "global_t": values[58:]}
            pose, betas, place = (np.ravel(np.asarray(values[key])) for key in ("poses", "shapes", "global_t"))
            mask = tree.file(f"mask_hand/{name.removeprefix('rgb/')}")
            view = numbers(entry(calibration, "M", camera, what="camera"), 4, 4, what="M")
            K = numbers(entry(calibration, "K", camera, what="camera"), 3, 3, what="K")
            parameters = pose_of_48(model, pose, betas, place, with_mean=False)
            sample = Sample(name, tree.file(name), None, "right", sequence, view, K, parameters, None)
            found.add(sample._replace(mask=mask if mask.exists else None), models)
    return found


def _freihand(tree: Tree, models: Models, split: Split) -> Catalogue:
    """training_{K,mano}.json, training/rgb/%08d.jpg, training/mask/%08d.jpg; only the training set has parameters."""
    tables = [read_table(tree.file(f"training_{part}.json")) for part in ("K", "mano")]
    if not all(isinstance(table, list) for table in tables) or len({len(table) for table in tables}) != 1:
        raise InputError(
            f"{tree.root}: training_K.json and training_mano.json are no lists of one length; download both again."
        )
    found, model = Catalogue(), models["right"]
    for k, (K, theta) in enumerate(zip(*tables, strict=True)):
        name = f"training/rgb/{k:08d}.jpg"
        with found.reading(name):
            K = numbers(K, 3, 3, what="K")
            theta = numbers(np.ravel(np.asarray(theta)), 61, what="mano")
            pose = pose_of_48(model, theta[:48], theta[48:58], np.zeros(3), with_mean=False)
            focal = 0.5 * (K[0, 0] + K[1, 1])
            root_joint = np.append(theta[58:60] - K[:2, 2], focal) / theta[60]
            pose = pose._replace(transl=root_joint - mano_surface(model, pose)[1][_ANCHOR])
            mask = tree.file(f"training/mask/{k:08d}.jpg")
            found.add(Sample(name, tree.file(name), mask, "right", f"{k}", np.eye(4), K, pose, None), models)
    return found


def _ho3d(tree: Tree, models: Models, split: Split) -> Catalogue:
    """SPLIT/SEQUENCE/rgb/*.{png,jpg} and meta/*.pkl, as HOnnotate writes them; OpenGL's axes."""
    found, model = Catalogue(), models["right"]
    for name in tree.names(split):
        parts = re.fullmatch(rf"{split}/([^/]+)/meta/([^/]+)\.pkl", name)
        if parts is None:
            continue
        with found.reading(name):
            meta = tree.file(name)
            values = read_pickle(meta.path, "annotations of HOnnotate", meta.read())
            pose = pose_of_48(model, values["handPose"], values["handBeta"], values["handTrans"], with_mean=True)
            stem = f"{split}/{parts[1]}/rgb/{parts[2]}"
            photo = next((file for s in PICTURES if (file := tree.file(stem + s)).exists), tree.file(stem))
            K = numbers(values["camMat"], 3, 3, what="camMat")
            subject = parts[1].rstrip("0123456789")
            found.add(Sample(name, photo, None, "right", subject, _FROM_OPENGL, K, pose, None), models)
    return found


def _photos(tree: Tree, models: Models, split: Split) -> Catalogue:
    """Any photos, beside each NAME.npz, NAME.pkl or NAME.json of an estimator of MANO (docs/mano.md), NAME.mask.png."""
    found = Catalogue()
    for name in tree.names():
        stem, dot, suffix = name.rpartition(".")
        if f"{dot}{suffix.lower()}" not in PICTURES or stem.endswith(".mask"):
            continue
        kind = next((s for s in (*SUFFIXES, ".json") if tree.file(stem + s).exists), None)
        if kind is None:
            found.left_out[name] = f"{name}: has no .npz, .pkl or .json of an estimator beside it."
            continue
        with found.reading(name):
            image, mask = tree.file(name), tree.file(f"{stem}.mask.png")
            photo, beside, path = image.photo(name), tree.file(stem + kind), Path(stem + kind)
            if kind == ".json":
                estimate = estimate_of_entries(path, read_table(beside), photo)
            else:
                estimate = read_estimate(path, photo, content=beside.read())
            estimated = _estimated(name, image, estimate)
            found.add(estimated._replace(mask=mask if mask.exists else None), models)
    return found


def _estimated(name: str, image: File, estimate: Estimate) -> Sample:
    """An estimate's hand: that of a left one is the right hand's mirror image, moved by the camera's place."""
    if estimate.pose is None:
        raise InputError(f"{name}: its estimate has no parameters of MANO.")
    pose = estimate.pose
    if estimate.side == "left":
        pose = mirror_mano_pose(pose)
    pose = pose._replace(transl=estimate.place)
    K = _intrinsics(estimate.focal, estimate.focal, *estimate.centre)
    return Sample(name, image, None, estimate.side, name, np.eye(4), K, pose, None)


def _view(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = rotation, translation
    return view


def _intrinsics(fx: float, fy: float, x: float, y: float) -> np.ndarray:
    return np.array([[fx, 0, x], [0, fy, y], [0, 0, 1]])


_READERS: dict[str, Callable[[Tree, Models, Split], Catalogue]] = {
    "hanco": _hanco, "freihand": _freihand, "ho3d": _ho3d, "coco-hand": _photos,
    "whim": _photos, "photos": _photos,
}  # fmt: skip
