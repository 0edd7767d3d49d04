"""Records that an evaluation keeps and goes on from: each is of one photo, and of the settings that are noted."""

from types import MappingProxyType

import pytest
import torch

from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.data.pictures import write_picture
from oasis_warp.evaluation import data_sets, looks, same_hand
from oasis_warp.evaluation.data_sets import Key


@pytest.fixture
def photos(tmp_path):
    """Writes different pictures to a folder."""

    def write(*names):
        for k, name in enumerate(names):
            path = tmp_path / "photos" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_picture(path, torch.full((40, 40, 3), 20 * k, dtype=torch.uint8))
        return tmp_path / "photos"

    return write


@pytest.mark.parametrize(
    ("names", "twins"),
    [
        (("a.png", "b.png", "a.jpg"), ("a.jpg", "a.png")),
        (("a.png", "mine/a.jpg", "mine/a.png"), ("mine/a.jpg", "mine/a.png")),
        (("a_b/c.png", "a/b_c.png", "d.png"), ("a/b_c.png", "a_b/c.png")),
    ],
)
def test_photos_that_would_share_a_record_are_refused_before_any_work(
    hand, photos, tmp_path, monkeypatch, names, twins
):
    """A broken a.jpg got the record of a.png."""
    folder = photos(*names)
    monkeypatch.setattr(looks, "HandEstimator", lambda *_: pytest.fail("began to work"))
    said = f"photos: {folder / twins[0]} and {folder / twins[1]} would share one record; rename one of them."
    with pytest.raises(InputError) as refused:
        looks.evaluate_looks(MeanPrior(hand), folder, tmp_path / "out", ReconstructConfig())
    assert str(refused.value) == said and not (tmp_path / "out").exists()


def test_pictures_of_a_data_set_have_files_of_their_own_and_plain_names_are_kept():
    """Cameras and frames of different pictures were joined to one name."""
    names = ("cam/1 a.jpg", "cam-1-a.jpg", "cam-1 a.jpg", "cam 1/a.jpg", "cam_1.a-b")
    files = [Key("a", name).file for name in names]
    assert len(set(files)) == len(names) and all("/" not in file and " " not in file for file in files)
    assert files[1] == names[1] and files[4] == names[4]


class Stop(Exception):
    """With the options that an evaluation hands on."""


@pytest.mark.parametrize("evaluation", ["looks", "same-hand", "data set"])
def test_options_that_are_not_noted_with_the_records_do_not_reach_the_avatars(
    hand, photos, tmp_path, monkeypatch, evaluation
):
    """A run could go on with the records of another: only what is noted is compared when it is started again."""

    def stop(*given, **_):
        raise Stop(next(part for part in given if isinstance(part, ReconstructConfig)))

    noted = {"steps": 3, "seed": 5}
    others = {"light": "keep", "unseen": "plain", "adapt": "lora", "force": True, "refine": "on", "hand": "left"}
    config, folder = ReconstructConfig(**noted, **others, size=64), photos("a.png", "b.png")
    monkeypatch.setattr(looks, "measure_all_real", lambda *_: ([], {}))
    monkeypatch.setattr(looks, "reconstruct", stop)
    monkeypatch.setattr(same_hand, "_measure_hand", stop)
    monkeypatch.setattr(data_sets, "_Measuring", stop)
    with pytest.raises(Stop) as stopped:
        if evaluation == "looks":
            looks.evaluate_looks(MeanPrior(hand), folder, tmp_path / "out", config)
        elif evaluation == "same-hand":
            same_hand.evaluate_photos({}, folder, tmp_path / "out", config)
        else:
            data_sets.evaluate_data_set(NoPictures(), {}, [], data_sets.Choice(), tmp_path / "out", config=config)
    size = {"size": 64} if evaluation == "same-hand" else {}
    expected = ReconstructConfig() if evaluation == "data set" else ReconstructConfig(**noted, **size)
    assert stopped.value.args == (expected,)


class NoPictures:
    """A data set without pictures."""

    keys, left_out = (), MappingProxyType({})

    def read(self, key):
        raise AssertionError(key)
