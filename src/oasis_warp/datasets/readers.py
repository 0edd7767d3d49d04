"""The file trees of published data sets -> `Catalogue`. Each reader names the files that it expects."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from oasis_warp.core.errors import InputError
from oasis_warp.core.pickle_reader import read_pickle
from oasis_warp.core.types import Photo, Side
from oasis_warp.data.photo import read_photo
from oasis_warp.datasets.samples import Catalogue, Models, Sample, entry, numbers, pose_of_48, read_table
from oasis_warp.estimation.mano_estimates import SUFFIXES, Estimate, estimate_of_entries, read_estimate
from oasis_warp.hand.mano import mano_surface, mirror_mano_pose, read_mano, thinned

DatasetName = Literal["interhand", "hanco", "freihand", "ho3d", "coco-hand", "whim", "photos"]
Split = Literal["train", "val", "test"]
PAPER_CAPTURES = {0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 20, 22, 23, 24, 25}
"""Of InterHand2.6M's training set, those that the paper trains on (appendix C)."""
EXCLUDED_SEQUENCES = {
    "0000_neutral_relaxed", "0009_thumbtucknormal", "0019_alligator_closed", "0029_indextip",
    "0039_fingerspreadrigid", "0048_index_point", "0058_middlefinger",
}  # fmt: skip
"""Which it leaves out of them."""
TEST_CAPTURE, TEST_SEQUENCE = 0, "ROM03_RT_No_Occlusion"
"""Of the test set, what it evaluates on."""
HANCO_SEQUENCE, HANCO_CAMERAS = 154, (0, 3, 5, 6, 7)
"""Of HanCo, what it evaluates on."""
PICTURES = (".jpg", ".jpeg", ".png", ".webp")
_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_ANCHOR = 4
"""MANO's first joint of the middle finger, landmark 9, which FreiHAND's root is."""


def read_dataset(name: DatasetName, root: Path, mano_dir: Path, split: Split = "train") -> Catalogue:
    """The samples of a data set below `root`, as the paper takes them.

    Raises:
        InputError: no such folder or annotation file, or not one sample in it.
    """
    if not root.is_dir():
        raise InputError(f"{root}: expected the folder of {name}, found none; give --root.")
    # A twentieth of the vertices tells whether a camera sees a hand; joints come from all of them.
    models: Models = {side: thinned(read_mano(mano_dir, side)) for side in get_args(Side)}
    found = _READERS[name](root, models, split)
    if not found.samples:
        reason = next(iter(found.left_out.values()), "there are no photos where it keeps them.")
        raise InputError(f"{root}: found no sample of {name} in it: {reason}")
    return found


def _interhand(root: Path, models: Models, split: Split) -> Catalogue:
    """annotations/SPLIT/InterHand2.6M_SPLIT_{data,camera,MANO_NeuralAnnot}.json, images/SPLIT/...; millimetres."""
    folder = root / "annotations" / split
    data, cameras, mano = (
        read_table(folder / f"InterHand2.6M_{split}_{part}.json") for part in ("data", "camera", "MANO_NeuralAnnot")
    )
    found = Catalogue()
    images = {}
    for image in entry(data, "images", what="table"):
        with found.reading(f"{split}/{image.get('file_name') if isinstance(image, dict) else '?'}"):
            images[image["id"]] = image
    for annotation in entry(data, "annotations", what="table"):
        image = images.get(annotation.get("image_id")) if isinstance(annotation, dict) else None
        name = f"{split}/{image['file_name']}" if image and "file_name" in image else f"annotation of {split}"
        with found.reading(name):
            if image is None:
                raise InputError(f"{name}: names a photo that is not listed.")
            capture = int(image["capture"])
            if not _in_paper(split, capture, image["seq_name"]) or annotation["hand_type"] not in models:
                continue
            side: Side = annotation["hand_type"]
            values = entry(mano, capture, image["frame_idx"], side, what="MANO parameters of")
            if values is None:
                raise InputError(f"{name}: has no MANO parameters of the {side} hand.")
            number = str(image["camera"])
            place, turn, focal, middle = (
                numbers(entry(cameras, capture, part, number, what="camera"), *shape, what=part)
                for part, shape in (("campos", (3,)), ("camrot", (3, 3)), ("focal", (2,)), ("princpt", (2,)))
            )
            pose = pose_of_48(models[side], values["pose"], values["shape"], values["trans"], with_mean=False)
            box = numbers(annotation["bbox"], 4, what="bbox")
            photo = root / "images" / split / image["file_name"]
            sample = Sample(
                f"{name} {side}", photo, None, side, f"{split}/Capture{capture}", _view(turn, -turn @ place / 1000),
                _intrinsics(*focal, *middle), pose, box,
            )  # fmt: skip
            found.add(sample, models)
    return found


def _in_paper(split: Split, capture: int, sequence: str) -> bool:
    if split == "test":
        return capture == TEST_CAPTURE and sequence == TEST_SEQUENCE
    return split != "train" or (capture in PAPER_CAPTURES and sequence not in EXCLUDED_SEQUENCES)


def _hanco(root: Path, models: Models, split: Split) -> Catalogue:
    """rgb/SSSS/camC/F.jpg, mask_hand beside rgb, calib/SSSS/F.json (K, M), shape/SSSS/F.json; all right hands."""
    found, model = Catalogue(), models["right"]
    folders = sorted((root / "rgb").glob("[0-9]*"))
    for folder in [root / "rgb" / f"{HANCO_SEQUENCE:04d}"] if split == "test" else folders:
        for photo in sorted(folder.glob("cam*/*.jpg")):
            camera, name = int(photo.parent.name.removeprefix("cam")), photo.relative_to(root).as_posix()
            if split == "test" and camera not in HANCO_CAMERAS:
                continue
            with found.reading(name):
                frame = f"{folder.name}/{photo.stem}.json"
                calibration, values = read_table(root / "calib" / frame), read_table(root / "shape" / frame)
                if isinstance(values, list):  # shapes, poses, place in one row
                    values = {"shapes": values[:10], "poses": values[10:58], "global_t": values[58:]}
                pose, betas, place = (np.ravel(np.asarray(values[key])) for key in ("poses", "shapes", "global_t"))
                mask = root / "mask_hand" / photo.relative_to(root / "rgb")
                view = numbers(entry(calibration, "M", camera, what="camera"), 4, 4, what="M")
                K = numbers(entry(calibration, "K", camera, what="camera"), 3, 3, what="K")
                parameters = pose_of_48(model, pose, betas, place, with_mean=False)
                sample = Sample(name, photo, mask if mask.is_file() else None, "right", folder.name, view, K,
                                parameters, None)  # fmt: skip
                found.add(sample, models)
    return found


def _freihand(root: Path, models: Models, split: Split) -> Catalogue:
    """training_{K,mano}.json, training/rgb/%08d.jpg, training/mask/%08d.jpg; only the training set has parameters."""
    tables = [read_table(root / f"training_{part}.json") for part in ("K", "mano")]
    if len({len(table) for table in tables}) != 1:
        raise InputError(f"{root}: training_K.json and training_mano.json have different lengths; download both again.")
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
            mask = root / "training" / "mask" / f"{k:08d}.jpg"
            found.add(Sample(name, root / name, mask, "right", f"{k}", np.eye(4), K, pose, None), models)
    return found


def _ho3d(root: Path, models: Models, split: Split) -> Catalogue:
    """SPLIT/SEQUENCE/rgb/*.{png,jpg} and meta/*.pkl, as HOnnotate writes them; OpenGL's axes."""
    found, model = Catalogue(), models["right"]
    for meta in sorted((root / split).glob("*/meta/*.pkl")):
        name = meta.relative_to(root).as_posix()
        with found.reading(name):
            values = read_pickle(meta, "annotations of HOnnotate")
            pose = pose_of_48(model, values["handPose"], values["handBeta"], values["handTrans"], with_mean=True)
            folder = meta.parents[1] / "rgb"
            photo = next((p for s in PICTURES if (p := folder / f"{meta.stem}{s}").is_file()), folder / meta.stem)
            K = numbers(values["camMat"], 3, 3, what="camMat")
            subject = meta.parents[1].name.rstrip("0123456789")
            found.add(Sample(name, photo, None, "right", subject, _FROM_OPENGL, K, pose, None), models)
    return found


def _photos(root: Path, models: Models, split: Split) -> Catalogue:
    """Any photos, beside each NAME.npz, NAME.pkl or NAME.json of an estimator of MANO (docs/mano.md)."""
    found = Catalogue()
    for path in sorted(p for p in root.rglob("*") if p.suffix.lower() in PICTURES):
        name = path.relative_to(root).as_posix()
        beside = next((p for s in (*SUFFIXES, ".json") if (p := path.with_suffix(s)).is_file()), None)
        if beside is None:
            found.left_out[name] = f"{name}: has no .npz, .pkl or .json of an estimator beside it."
            continue
        with found.reading(name):
            photo = read_photo(path)
            found.add(_estimated(name, path, _estimate(beside, photo), photo), models)
    return found


def _estimate(path: Path, photo: Photo) -> Estimate:
    if path.suffix == ".json":
        return estimate_of_entries(path, read_table(path), photo)
    return read_estimate(path, photo)


def _estimated(name: str, path: Path, estimate: Estimate, photo: Photo) -> Sample:
    """An estimate's hand: that of a left one is the right hand's mirror image, moved by the camera's place."""
    if estimate.pose is None:
        raise InputError(f"{name}: its estimate has no parameters of MANO.")
    pose = estimate.pose
    if estimate.side == "left":
        pose = mirror_mano_pose(pose)
    pose = pose._replace(transl=estimate.place)
    K = _intrinsics(estimate.focal, estimate.focal, *estimate.centre)
    return Sample(name, path, None, estimate.side, name, np.eye(4), K, pose, None)


def _view(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = rotation, translation
    return view


def _intrinsics(fx: float, fy: float, x: float, y: float) -> np.ndarray:
    return np.array([[fx, 0, x], [0, fy, y], [0, 0, 1]])


_READERS: dict[DatasetName, Callable[[Path, Models, Split], Catalogue]] = {
    "interhand": _interhand, "hanco": _hanco, "freihand": _freihand, "ho3d": _ho3d, "coco-hand": _photos,
    "whim": _photos, "photos": _photos,
}  # fmt: skip
