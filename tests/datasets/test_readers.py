"""Readers of data sets, on small trees in the published formats, and batches of what they read."""

import itertools
import json
import pickle
import re
from typing import Any

import numpy as np
import pytest
import torch
from datasets.trees import WRITERS, K, dump

from oasis_warp.core.errors import InputError
from oasis_warp.datasets.readers import EXCLUDED_SEQUENCES, PAPER_CAPTURES, read_dataset
from oasis_warp.datasets.samples import load_picture
from oasis_warp.datasets.training_source import TRIES, DatasetHands, MixedHands
from oasis_warp.hand.mano import mano_surface, read_mano
from oasis_warp.ops import depth_map


@pytest.fixture(scope="module")
def models(mano_dir):
    return {side: read_mano(mano_dir, side) for side in ("right", "left")}


@pytest.fixture(scope="module")
def trees(models, tmp_path_factory):
    """Written when first asked for; the root and the true points."""
    made = {}

    def tree(name):
        if name not in made:
            root = tmp_path_factory.mktemp(name)
            made[name] = root, WRITERS[name](root, models)
        return made[name]

    return tree


def drawn(sample, models):
    vertices, joints = mano_surface(models[sample.side], sample.mano)
    points = np.concatenate([joints, vertices]) @ sample.viewmat[:3, :3].T + sample.viewmat[:3, 3]
    seen = points @ sample.K.T
    return seen[:, :2] / seen[:, 2:]


@pytest.mark.parametrize("name", WRITERS)
def test_hands_are_drawn_where_the_data_set_has_them(name, trees, models, mano_dir):
    root, truth = trees(name)
    found = read_dataset(name, root, mano_dir)
    assert not found.left_out and found.samples
    for sample in found.samples:
        assert np.abs(drawn(sample, models) - truth[sample.name]).max() < 1e-3


@pytest.mark.parametrize("name", ["interhand", "hanco", "photos"])
def test_crops_are_squares_around_the_box_with_the_camera_that_fits(name, trees, models, mano_dir):
    root, _ = trees(name)
    for sample in read_dataset(name, root, mano_dir).samples[:4]:
        picture = load_picture(sample, models, 256)
        extent = (np.ptp(drawn(sample, models)[16:], axis=0) if sample.box is None else sample.box[2:]).max()
        assert float(picture.camera.K[0, 0] / K[0, 0]) == pytest.approx(256 / (1.3 * extent))
        right = mano_surface(models["right"], picture.mano)[1][0]
        at = picture.camera.viewmat[:3, :3].numpy() @ right + picture.camera.viewmat[:3, 3].numpy()
        x, y = (picture.camera.K.numpy() @ at)[:2] / at[2]
        red = (picture.image[..., 0] - picture.image[..., 2]).clamp_min(0) ** 4
        rows, columns = (torch.arange(256) + 0.5 for _ in range(2))
        dot = (red.sum(0) @ columns / red.sum(), red.sum(1) @ rows / red.sum())
        assert abs(float(dot[0]) - x) < 6 and abs(float(dot[1]) - y) < 6  # a pixel of the photo is 2 to 3 here


def test_the_papers_splits_of_interhand_and_hanco(trees, models, mano_dir, tmp_path):
    root, truth = trees("interhand")
    names = [sample.name for sample in read_dataset("interhand", root, mano_dir).samples]
    assert len(names) == 2 and all("Capture0/0007" in name for name in names) and len(truth) == 8
    WRITERS["interhand"](tmp_path, models, "test")
    tested = read_dataset("interhand", tmp_path, mano_dir, "test").samples
    assert {sample.name.split("/")[2] for sample in tested} == {"ROM03_RT_No_Occlusion"}
    assert all("Capture0" in sample.subject for sample in tested)
    assert len(PAPER_CAPTURES) == 21 and len(EXCLUDED_SEQUENCES) == 7
    root, _ = trees("hanco")
    assert len(read_dataset("hanco", root, mano_dir).samples) == 32
    tested = read_dataset("hanco", root, mano_dir, "test").samples
    assert {sample.name.split("/")[1] for sample in tested} == {"0154"} and len(tested) == 10
    assert {sample.name.split("/")[2] for sample in tested} == {f"cam{c}" for c in (0, 3, 5, 6, 7)}


def _json(relative, change):
    def damage(root):
        path = root / relative
        value = json.loads(path.read_text())
        change(value)
        dump(path, value)

    return damage


def _cameras(part, change):
    name = "annotations/train/InterHand2.6M_train_camera.json"
    return _json(name, lambda v: v["0"].__setitem__(part, change(v["0"][part])))


def _mano(change):
    name = "annotations/train/InterHand2.6M_train_MANO_NeuralAnnot.json"
    return _json(name, lambda v: change(v["0"]["0"]["right"]))


def _image(change):
    return _json("annotations/train/InterHand2.6M_train_data.json", lambda v: change(v["images"][0]))


def _annotation(change):
    return _json("annotations/train/InterHand2.6M_train_data.json", lambda v: change(v["annotations"][0]))


def _meta(change):
    def damage(root):
        path = root / "train/ABF10/meta/0000.pkl"
        value = pickle.loads(path.read_bytes())
        change(value)
        path.write_bytes(pickle.dumps(value, 2))

    return damage


FIRST = "Capture0/0007_thumbup_relaxed/cam400002/image0.jpg"
DAMAGE = {
    "no photo": ("interhand", lambda r: (r / "images/train" / FIRST).unlink(), "the photo image0.jpg is missing"),
    "no photos": ("interhand", _json("annotations/train/InterHand2.6M_train_data.json", lambda v: v.pop("images")),
                  "has no list of images"),
    "a number": ("interhand", _json("annotations/train/InterHand2.6M_train_data.json",
                 lambda v: v.update(annotations=3)), "has no list of annotations"),
    "no camera": ("interhand", _cameras("focal", lambda t: {k: t[k] for k in t if k != "400002"}), "camera 400002"),
    "camera cut": ("interhand", _cameras("campos", lambda t: t | {"400002": [1, 2]}), "campos: expected 3 numbers"),
    "camera turned": ("interhand", _cameras("camrot", lambda t: t | {"400002": [[1, 0]]}), "camrot: expected 3 x 3"),
    "camera texts": ("interhand", _cameras("princpt", lambda t: t | {"400002": ["a", 1]}), "princpt: expected 2"),
    "camera in metres": ("interhand", _cameras("campos", lambda t: t | {"400002": [9e6] * 3}), "does not see the hand"),
    "pose cut": ("interhand", _mano(lambda v: v["pose"].pop()), "pose: expected 48 numbers"),
    "pose nested": ("interhand", _mano(lambda v: v.update(pose=[[0] * 48])), "pose: expected 48 numbers"),
    "pose not finite": ("interhand", _mano(lambda v: v["pose"].__setitem__(0, float("nan"))), "pose: expected finite"),
    "no pose": ("interhand", _mano(lambda v: v.pop("pose")), "the annotation 'pose' is missing"),
    "shape cut": ("interhand", _mano(lambda v: v["shape"].pop()), "shape: expected 10 numbers"),
    "no shape": ("interhand", _mano(lambda v: v.pop("shape")), "the annotation 'shape' is missing"),
    "place cut": ("interhand", _mano(lambda v: v["trans"].pop()), "trans: expected 3 numbers"),
    "place far": ("interhand", _mano(lambda v: v.update(trans=[0, 0, 1e4])), "does not see the hand"),
    "no parameters": ("interhand", lambda r: _json("annotations/train/InterHand2.6M_train_MANO_NeuralAnnot.json",
                      lambda v: v["0"]["0"].update(right=None))(r), "has no MANO parameters of the right hand"),
    "no frame": ("interhand", lambda r: _json("annotations/train/InterHand2.6M_train_MANO_NeuralAnnot.json",
                 lambda v: v["0"].pop("0"))(r), "MANO parameters of 0"),
    "box cut": ("interhand", _annotation(lambda v: v["bbox"].pop()), "bbox: expected 4 numbers"),
    "box elsewhere": ("interhand", _annotation(lambda v: v.update(bbox=[5000, 5000, 90, 90])), "lies outside its box"),
    "no box": ("interhand", _annotation(lambda v: v.pop("bbox")), "the annotation 'bbox' is missing"),
    "other photo": ("interhand", _annotation(lambda v: v.update(image_id=999)), "names a photo that is not listed"),
    "no capture": ("interhand", _image(lambda v: v.pop("capture")), "the annotation 'capture' is missing"),
    "capture in words": ("interhand", _image(lambda v: v.update(capture="zero")), "a damaged annotation"),
    "a long name": ("interhand", _image(lambda v: v.update(file_name="x" * 300)), "the photo x+ is missing"),
    "no frame number": ("interhand", _image(lambda v: v.pop("frame_idx")), "the annotation 'frame_idx' is missing"),
    "no calibration": ("hanco", lambda r: (r / "calib/0003/00000000.json").unlink(), "calib.* cannot be read"),
    "calibration cut": ("hanco", _json("calib/0003/00000000.json", lambda v: v["M"].pop(7)), "camera 7"),
    "no K": ("hanco", _json("calib/0003/00000000.json", lambda v: v.pop("K")), "camera K"),
    "shape file": ("hanco", lambda r: (r / "shape/0003/00000001.json").write_text("{"), "expected JSON"),
    "no global_t": ("hanco", _json("shape/0003/00000001.json", lambda v: v.pop("global_t")), "'global_t' is missing"),
    "row cut": ("hanco", _json("shape/0003/00000000.json", lambda v: v.pop()), "trans: expected 3 numbers"),
    "mano cut": ("freihand", _json("training_mano.json", lambda v: v[0][0].pop()), "mano: expected 61 numbers"),
    "K turned": ("freihand", _json("training_K.json", lambda v: v.__setitem__(0, [1, 2])), "K: expected 3 x 3"),
    "K of zeros": ("freihand", _json("training_K.json", lambda v: v.__setitem__(0, [[0] * 3] * 3)), "no camera"),
    "scale 0": ("freihand", _json("training_mano.json", lambda v: v[0][0].__setitem__(60, -9.0)), "does not see"),
    "no mask": ("freihand", lambda r: (r / "training/mask/00000000.jpg").unlink(), "the mask 00000000.jpg is missing"),
    "meta cut": ("ho3d", lambda r: (r / "train/ABF10/meta/0000.pkl").write_bytes(b"\x80\x02}"), "no pickle of plain"),
    "no beta": ("ho3d", _meta(lambda v: v.pop("handBeta")), "the annotation 'handBeta' is missing"),
    "None in pose": ("ho3d", _meta(lambda v: v.update(handPose=None)), "pose: expected 48 numbers"),
    "no estimate": ("photos", lambda r: (r / "some/photo0.npz").unlink(), "has no .npz, .pkl or .json"),
    "bad estimate": ("photos", lambda r: (r / "some/photo0.npz").write_bytes(b"PK"), "expected arrays of numbers"),
    "bad photo": ("photos", lambda r: (r / "some/photo0.png").write_bytes(b"PNG"), "photo0.png"),
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_broken_sample_is_left_out_with_its_reason_and_the_others_stay(kind, models, mano_dir, tmp_path):
    name, damage, message = DAMAGE[kind]
    WRITERS[name](tmp_path, models)
    whole = len(read_dataset(name, tmp_path, mano_dir).samples)
    damage(tmp_path)
    try:
        found = read_dataset(name, tmp_path, mano_dir)
    except InputError as error:  # both samples of a small tree, whose tables are shared
        assert re.search(message, str(error))
        return
    reasons = " ".join(found.left_out.values())
    assert re.search(message, reasons), reasons
    assert 0 < len(found.samples) < whole and len(found.samples) + len(found.left_out) >= whole


ANYTHING = (None, "text", [], {}, [[1]], [float("nan")], 1e300, 10**400, {"a": [1]}, "\x1b[31m")
"""What a part of an annotation is replaced with; it is also left out."""
MISSING = object()
PARTS = {
    "interhand": [
        *(("annotations/train/InterHand2.6M_train_data.json", ("images", 0, key)) for key in ("capture", "frame_idx")),
        *(("annotations/train/InterHand2.6M_train_data.json", ("annotations", 0, key)) for key in ("image_id", "bbox")),
        *(("annotations/train/InterHand2.6M_train_camera.json", ("0", key, "400002"))
          for key in ("campos", "camrot", "focal", "princpt")),
        *(("annotations/train/InterHand2.6M_train_MANO_NeuralAnnot.json", ("0", "0", "right", key))
          for key in ("pose", "shape", "trans")),
    ],
    "hanco": [("calib/0154/00000001.json", ("K", 0)), ("calib/0154/00000001.json", ("M", 3)),
              *(("shape/0154/00000001.json", (key,)) for key in ("poses", "shapes", "global_t"))],
    "freihand": [("training_K.json", (0,)), ("training_K.json", (0, 1)), ("training_K.json", (0, 0, 0)),
                 ("training_mano.json", (0,)), ("training_mano.json", (0, 0, 5))],
    "ho3d": [("train/ABF10/meta/0000.pkl", (key,)) for key in ("camMat", "handPose", "handBeta", "handTrans")],
    "photos": [("some/photo2.json", (key,)) for key in ("global_orient", "hand_pose", "betas", "cam_t")],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", PARTS)
def test_no_part_of_an_annotation_may_be_anything_else(name, models, mano_dir, tmp_path):
    WRITERS[name](tmp_path, models)
    split = "test" if name == "hanco" else "train"
    whole, kinds = len(read_dataset(name, tmp_path, mano_dir, split).samples), 0
    for file, (*way, last) in PARTS[name]:
        path = tmp_path / file
        kept, pickled = path.read_bytes(), file.endswith(".pkl")
        for value in (MISSING, *ANYTHING):
            table = part = pickle.loads(kept) if pickled else json.loads(kept)
            for key in way:
                part = part[key]
            if value is MISSING:
                del part[last]
            else:
                part[last] = value
            path.write_bytes(pickle.dumps(table, 2) if pickled else json.dumps(table).encode())
            what = f"{file} {last}: {value!r}"[:200]
            try:
                found = read_dataset(name, tmp_path, mano_dir, split)
                reasons = list(found.left_out.values())
                assert 0 < len(found.samples) < whole and reasons, what
            except InputError as error:  # of both photos of a small tree, or of the whole table
                reasons = [str(error)]
            for said in reasons:
                assert said.endswith(".") and "\n" not in said and "\x1b" not in said and len(said) < 700, what
            kinds += 1
        path.write_bytes(kept)
    assert kinds >= 30


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_that_is_none_of_it_is_refused(name, mano_dir, tmp_path):
    with pytest.raises(InputError, match="expected the folder of"):
        read_dataset(name, tmp_path / "gone", mano_dir)
    with pytest.raises(InputError, match="cannot be read|found no sample"):
        read_dataset(name, tmp_path, mano_dir)


def source(name, root, models, mano, mano_dir, **options):
    WRITERS[name](root, models)
    settings = {"seed": 0, "hands": 2, "views": 2, "size": 96, "device": torch.device("cpu")} | options
    return DatasetHands(catalogue=read_dataset(name, root, mano_dir), models=models, hand=mano, **settings)


@pytest.mark.parametrize("name", ["hanco", "photos"])
def test_surfaces_of_a_batch_lie_on_its_pictures(name, models, mano, mano_dir, tmp_path):
    hands = source(name, tmp_path, models, mano, mano_dir)
    batch = next(hands(0, 0, 1))
    assert batch.image.shape == (2, 96, 96, 3) and batch.target_images.shape == (2, 2, 96, 96, 3)
    still = torch.eye(4).expand(2, -1, -1)
    seen = depth_map(batch.posed, mano.faces, still, batch.K, 96, 96).face_ids >= 0
    overlap = (seen & (batch.mask > 0.5)).sum((1, 2)) / (seen | (batch.mask > 0.5)).sum((1, 2))
    # Masks have an estimator's errors, and the tree draws the convex hull as HanCo's.
    assert (overlap > (0.5 if name == "hanco" else 0.75)).all()
    outside = batch.target_images * (batch.target_masks < 0.01)[..., None]
    assert float(outside.abs().max()) < 0.05


def test_batches_depend_on_their_number_alone_and_broken_photos_are_passed_over(models, mano, mano_dir, tmp_path):
    hands = source("hanco", tmp_path, models, mano, mano_dir, hands=1, views=1)
    batches = hands(0, 0, 1)
    first, second = next(batches), next(batches)
    again = next(hands(1, 0, 1))
    assert all(torch.equal(a, b) for a, b in zip(second, again, strict=True))
    assert not torch.equal(first.image, second.image)
    for sample in hands.catalogue.samples[::2]:
        sample.image.path.write_bytes(b"")
    for _ in range(4):
        next(batches)
    assert hands.failed and all("jpg" in reason for reason in hands.failed.values())
    for sample in hands.catalogue.samples:
        sample.image.path.write_bytes(b"")
    with pytest.raises(InputError, match=f"{TRIES} photos of 0.* could not be read, the last"):
        for _ in range(2):  # one batch was loaded ahead, perhaps before the photos were gone
            next(batches)


def test_other_processes_load_the_same_pictures_and_say_which_are_broken(models, mano, mano_dir, tmp_path):
    """Pictures that pass between processes, and the samples that take the place of those that cannot be read."""
    alone, pool = (
        source("hanco", tmp_path / "tree", models, mano, mano_dir, hands=1, views=1, workers=n) for n in (0, 1)
    )
    for sample in alone.catalogue.samples[::2]:
        sample.image.path.write_bytes(b"")
    pairs = zip(alone.loaded(3, 0, 2), pool.loaded(3, 0, 2), strict=False)
    for (number, *pictures), (other, *others) in itertools.islice(pairs, 4):
        assert number == other
        for one, two in zip(itertools.chain(*pictures), itertools.chain(*others), strict=True):
            assert all(np.array_equal(a, b) for a, b in zip((*one[:4], *one.mano), (*two[:4], *two.mano), strict=True))
    assert number == 12 and alone.failed and alone.failed == pool.failed


def test_a_mixture_takes_its_share_of_each_source_and_resumes_at_any_step():
    class Numbered:
        seed = 0

        def __init__(self, name):
            self.name = name

        def __call__(self, first_step, rank, world):
            while True:
                yield self.name, first_step * world + rank
                first_step += 1

    mixed: Any = MixedHands.__new__(MixedHands)
    for name, value in {"real": Numbered("real"), "synthetic": Numbered("synthetic"), "weight": 0.3}.items():
        object.__setattr__(mixed, name, value)
    whole = list(itertools.islice(mixed(0, 0, 1), 400))
    assert 90 < sum(name == "real" for name, _ in whole) < 150
    assert [number for name, number in whole if name == "real"][:3] == [0, 1, 2]
    for start in (1, 7, 50):
        assert next(mixed(start, 0, 1)) == whole[start]
