import json
import shutil
import tarfile

import cv2
import numpy as np
import pytest
import torch

from oasis_warp import cli
from oasis_warp.cli.progress import BAD_INPUT, INTERRUPTED
from oasis_warp.core.errors import InputError
from oasis_warp.data.pictures import contact_sheet, write_picture
from oasis_warp.synthetic import shards
from oasis_warp.synthetic.picture import render_batch
from oasis_warp.synthetic.rooms import cut_background, list_backgrounds
from oasis_warp.synthetic.shards import write_shards
from oasis_warp.synthetic.shots import PHOTOS, SceneConfig

SIZE = 32
JOB = {"count": 5, "seed": 13, "size": SIZE, "device": "cpu", "scene": PHOTOS, "batch": 2}


@pytest.fixture(autouse=True)
def small_shards(monkeypatch):
    monkeypatch.setattr(shards, "SHARD", 2)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Shards of a run that nothing stopped."""
    patch = pytest.MonkeyPatch()
    patch.setattr(shards, "SHARD", 2)
    folder = tmp_path_factory.mktemp("whole") / "hands"
    assert write_shards(folder, **JOB) == 5
    patch.undo()
    return folder


def _files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def _member(tar, name):
    with tar.extractfile(name) as file:
        return file.read()


def _decoded(data):
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))


def test_shards_hold_every_picture_once_and_the_truth_beside_it(whole):
    assert sorted(_files(whole)) == ["dataset.json", *(f"hands-{k:06d}.tar" for k in range(3))]
    with tarfile.open(whole / "hands-000001.tar") as tar:
        names = tar.getnames()
        truth = json.loads(_member(tar, "00000002.json"))
        mask, depth = (_decoded(_member(tar, f"00000002.{kind}.png")) for kind in ("mask", "depth"))
    assert names == [f"{k:08d}.{end}" for k in (2, 3) for end in ("jpg", "mask.png", "depth.png", "json")]
    batch = render_batch(13, [2], SIZE)
    np.testing.assert_allclose(truth["landmarks"], batch.landmarks[0], atol=1e-3)
    np.testing.assert_allclose(mask / 255, batch.mask[0], atol=0.004)
    there = batch.depth[0].isfinite().numpy()
    np.testing.assert_allclose(depth[there] * shards.DEPTH_UNIT, batch.depth[0].numpy()[there], atol=1e-4)
    assert not depth[~there].any()


def test_a_run_that_was_stopped_goes_on_and_ends_with_the_same_files(whole, tmp_path):
    folder = tmp_path / "hands"

    def stop(stage, done, total):
        if done > 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_shards(folder, **JOB, progress=stop)
    assert sorted(_files(folder)) == ["dataset.json", "hands-000000.tar"]  # nothing half-written
    assert write_shards(folder, **JOB) == 3
    assert _files(folder) == _files(whole)


def test_a_finished_folder_is_left_as_it_is_and_a_larger_count_adds_to_it(whole, tmp_path):
    folder = tmp_path / "hands"
    write_shards(folder, **(JOB | {"count": 3}))
    (folder / ".hands-000000.01234567.part.tar").touch()  # a second run was killed while the first finished the shard
    assert write_shards(folder, **(JOB | {"count": 3})) == 0
    assert not list(folder.glob(".*"))
    assert write_shards(folder, **JOB) == 3  # the last shard was not full
    assert _files(folder) == _files(whole)


def test_a_folder_of_other_pictures_is_refused(whole):
    with pytest.raises(InputError, match="made with other settings"):
        write_shards(whole, **(JOB | {"seed": 14}))


def _folder_of_pictures(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    pixels = torch.zeros(50, 70, 3, dtype=torch.uint8)
    pixels[..., 1] = 200
    write_picture(folder / "green.png", pixels)
    return folder


def test_a_cut_shard_is_written_again_and_unreadable_settings_are_others(whole, tmp_path):
    folder = tmp_path / "hands"
    shutil.copytree(whole, folder)
    shard = folder / "hands-000002.tar"
    shard.write_bytes(shard.read_bytes()[:700])
    assert write_shards(folder, **JOB) == 1
    assert _files(folder) == _files(whole)
    for text in (b"[1]", b"", b"\xff", b"[" * 100_000):
        (folder / "dataset.json").write_bytes(text)
        with pytest.raises(InputError, match=r"made with other settings \(see dataset.json\)"):
            write_shards(folder, **JOB)


def test_a_folder_of_pictures_stands_behind_the_hands(tmp_path):
    paths = list_backgrounds(_folder_of_pictures(tmp_path))
    batch = render_batch(13, [1], SIZE, scene=SceneConfig(backgrounds=paths))
    behind = batch.image[0][batch.alpha[0] == 0]
    assert float((behind[:, 1] - behind[:, [0, 2]].amax(1)).median()) > 0.1


def test_a_cut_background_is_square_bright_and_the_same_each_time(tmp_path):
    paths = list_backgrounds(_folder_of_pictures(tmp_path))
    a, b = (cut_background(paths, np.random.default_rng(4), 40, 1.0) for _ in range(2))
    assert a.shape == (40, 40, 3)
    assert float(a.mean()) == pytest.approx(0.3, abs=1e-3)
    torch.testing.assert_close(a, b)


def test_a_broken_background_is_refused_in_one_sentence(tmp_path, capsys):
    folder = _folder_of_pictures(tmp_path)
    (folder / "torn.jpg").write_bytes(b"\xff\xd8\xff\xe0 not much of a picture")
    code = cli.main(["synthesize", str(tmp_path / "out"), "--backgrounds", str(folder)])
    output = capsys.readouterr().err
    assert code == BAD_INPUT
    assert "torn.jpg" in output and output.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--count", "0"], "--count: expected 1 or more"),
        (["--size", "8"], "--size: expected 32 to 1024"),
        (["--seed", "-1"], "--seed: expected 0 or more"),
        (["--backgrounds", "nowhere"], "expected a folder of pictures"),
    ],
)
def test_wrong_options_are_one_sentence(tmp_path, capsys, arguments, words):
    assert cli.main(["synthesize", str(tmp_path / "out"), *arguments]) == BAD_INPUT
    assert words in capsys.readouterr().err


def test_an_empty_folder_of_backgrounds_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected pictures"):
        list_backgrounds(tmp_path)


def test_the_command_writes_a_sheet(tmp_path):
    out = tmp_path / "sheet.png"
    assert cli.main(["synthesize", str(out), "--sheet", "--count", "2", "--size", "32", "--seed", "13"]) == 0
    assert _decoded(out.read_bytes()).shape == (32, 66, 3)


def test_a_sheet_places_pictures_in_rows():
    images = torch.arange(3).float()[:, None, None, None].expand(3, 4, 5, 3) / 4
    sheet = contact_sheet(images, 2, gap=1)
    assert sheet.shape == (9, 11, 3)
    assert float(sheet[0, 6, 0]) == 0.25 and float(sheet[5, 0, 0]) == 0.5 and float(sheet[8, 10, 0]) == 1


def test_ctrl_c_keeps_what_is_whole_and_says_so(tmp_path, monkeypatch, capsys):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("oasis_warp.cli.synthesize.write_shards", stopped)
    assert cli.main(["synthesize", str(tmp_path / "out")]) == INTERRUPTED
    assert "the same command continues" in capsys.readouterr().err
