"""People that are baked once, written, and read again."""

import pytest
import torch

from oasis_warp.synthetic import people
from oasis_warp.synthetic.body import device_name
from oasis_warp.synthetic.shots import EVERYBODY

SEED = 13


@pytest.fixture(autouse=True)
def nobody_known(monkeypatch):
    monkeypatch.setattr(people, "_cache", type(people._cache)())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("people")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(people, "_cache", type(people._cache)())
        people.bake_people(SEED, [2], EVERYBODY, "cpu", jobs=0, folder=made)
    return made


def test_a_person_that_was_written_is_read_and_not_baked(folder, monkeypatch):
    baked = people._bake_person(SEED, 2, EVERYBODY, "cpu")
    monkeypatch.setattr(people, "_bake_person", None)
    told = []
    people.bake_people(SEED, [2], EVERYBODY, "cpu", jobs=0, folder=folder, progress=lambda *what: told.append(what))
    read = people.person(SEED, 2, EVERYBODY, "cpu")
    assert told == [("people", 0, 1), ("people", 1, 1)]
    assert read.ring_look == baked.ring_look and read.identity.seed == baked.identity.seed
    for name, value in baked._asdict().items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == getattr(read, name).dtype and torch.equal(value, getattr(read, name)), name


def test_a_device_has_one_name(monkeypatch):
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    assert [device_name(d) for d in ("cpu", "cuda", "cuda:0", torch.device("cuda"))] == [
        "cpu", "cuda:1", "cuda:0", "cuda:1"
    ]  # fmt: skip


@pytest.mark.parametrize("damage", ["cut short", "another's"])
def test_a_file_that_is_damaged_or_of_somebody_else_is_made_again(folder, tmp_path, monkeypatch, damage):
    data = (folder / "000002.safetensors").read_bytes()
    number = 2 if damage == "cut short" else 3
    (tmp_path / f"{number:06d}.safetensors").write_bytes(data[:1000] if damage == "cut short" else data)
    asked = []
    there = people._read(folder / "000002.safetensors", SEED, 2, EVERYBODY)
    monkeypatch.setattr(people, "_bake_person", lambda *who: asked.append(who) or there)
    people.bake_people(SEED, [number], EVERYBODY, "cpu", jobs=0, folder=tmp_path)
    assert asked == [(SEED, number, EVERYBODY, "cpu")]
