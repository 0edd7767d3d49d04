"""Data sets in tar files: the same samples as unpacked, and nothing of a hostile archive."""

import io
import json
import tarfile

import pytest
import torch
from datasets.trees import WRITERS

from oasis_warp.core.errors import InputError
from oasis_warp.datasets.readers import read_dataset, read_selection
from oasis_warp.datasets.samples import MAX_BYTES, Tree, load_picture
from oasis_warp.hand.mano import read_mano


@pytest.fixture(scope="module")
def models(mano_dir):
    return {side: read_mano(mano_dir, side) for side in ("right", "left")}


def pack(root, folder, parts=2):
    """All files of a tree in several tar files of another folder."""
    folder.mkdir()
    files = sorted(path for path in root.rglob("*") if path.is_file())
    for k in range(parts):
        with tarfile.open(folder / f"part-{k:03d}.tar", "w") as archive:
            for path in files[k::parts]:
                archive.add(path, path.relative_to(root).as_posix())


def archive_of(path, *members):
    """A tar file of (name or member, content)."""
    with tarfile.open(path, "w") as archive:
        for member, content in members:
            member = tarfile.TarInfo(member) if isinstance(member, str) else member
            member.size = len(content) if member.isreg() else 0
            archive.addfile(member, io.BytesIO(content))


@pytest.mark.parametrize("name", ["interhand", "hanco", "freihand", "ho3d", "photos"])
def test_what_is_packed_is_read_as_if_it_were_not(name, models, mano_dir, tmp_path):
    WRITERS[name](tmp_path / "plain", models)
    pack(tmp_path / "plain", tmp_path / "packed")
    plain, packed = (read_dataset(name, tmp_path / kind, mano_dir).samples for kind in ("plain", "packed"))
    assert [sample.name for sample in plain] == [sample.name for sample in packed] and len(plain) > 1
    for k in (0, -1):
        ours, theirs = load_picture(plain[k], models, 64), load_picture(packed[k], models, 64)
        assert torch.equal(ours.image, theirs.image) and torch.equal(ours.camera.K, theirs.camera.K)
        assert (ours.mask is None) == (theirs.mask is None)


def test_nothing_of_an_archive_is_taken_that_is_no_plain_file_of_the_folder(tmp_path):
    link, hole = tarfile.TarInfo("link"), tarfile.TarInfo("device")
    link.type, link.linkname, hole.type = tarfile.SYMTYPE, "/etc/passwd", tarfile.CHRTYPE
    archive_of(
        tmp_path / "a.tar", ("../out", b"1"), ("/root", b"2"), ("x/../../y", b"3"), ("C:/z", b"4"), (link, b""),
        (hole, b""), ("fine", b"5"), ("./also", b"6"), ("fine", b"7"),
    )  # fmt: skip
    tree = Tree(tmp_path)
    assert [name for name in tree.names() if not name.endswith(".tar")] == ["also", "fine"]
    assert tree.file("fine").read() == b"5" and tree.file("also").read() == b"6"
    message = " ".join(tree.left_out.values())
    assert len(tree.left_out) == 7
    assert "link is a link" in message and "../out leads out" in message and "twice" in message
    for name in ("../out", "/etc/passwd", "a/../../b", "a\\b"):
        with pytest.raises(InputError, match="leads out of the folder"):
            tree.file(name)
    assert {path.name for path in tmp_path.iterdir()} == {"a.tar"}  # nothing was unpacked


def test_bombs_and_damage_are_refused_or_named(tmp_path):
    archive_of(tmp_path / "a.tar", ("one", b"1" * 600), ("two", b"2" * 600), ("three", b"3" * 600))
    whole = (tmp_path / "a.tar").read_bytes()
    huge = tarfile.TarInfo("huge")
    huge.size = MAX_BYTES + 1
    cases = {
        "has more than 256 MB": huge.tobuf() + bytes(2048), "three is cut short": whole[:3800],
        "is damaged after 1536 bytes": whole[:1536] + b"x" * 512 + whole[2048:],
    }  # fmt: skip
    for message, content in cases.items():
        (tmp_path / "a.tar").write_bytes(content)
        tree = Tree(tmp_path)
        assert any(message in reason for reason in tree.left_out.values()), (message, tree.left_out)
    for content in (b"", b"hello" * 200, b"\x1f\x8b" + whole[2:]):
        (tmp_path / "a.tar").write_bytes(content)
        with pytest.raises(InputError, match="expected a tar file that is not compressed"):
            Tree(tmp_path)
    (tmp_path / "a.tar").write_bytes(whole)
    tree = Tree(tmp_path)
    (tmp_path / "a.tar").write_bytes(whole[:700])  # after it was opened
    with pytest.raises(InputError, match="is shorter than when it was opened"):
        tree.file("two").read()


def test_another_selection_of_interhand_comes_from_a_file(models, mano_dir, tmp_path):
    WRITERS["interhand"](tmp_path, models)
    WRITERS["interhand"](tmp_path, models, "test")
    path = tmp_path / "selection.json"
    path.write_text(json.dumps({"captures": [4], "excluded": [], "test_sequences": ["ROM04_X"], "test_step": 2}))
    chosen = read_selection(path)
    taken = read_dataset("interhand", tmp_path, mano_dir, "train", chosen).samples
    assert {sample.subject for sample in taken} == {"train/Capture4"} and len(taken) == 4
    tested = read_dataset("interhand", tmp_path, mano_dir, "test", chosen).samples
    assert len(tested) == 1 and "Capture0/ROM04_X" in tested[0].name
    for content, message in (
        ([], "expected some of captures"), ({"capture": [1]}, "got capture"), ({"captures": ["1"]}, "list of numbers"),
        ({"excluded": "x"}, "list of names"), ({"test_step": 0}, "whole number from 1"),
    ):  # fmt: skip
        path.write_text(json.dumps(content))
        with pytest.raises(InputError, match=message):
            read_selection(path)
