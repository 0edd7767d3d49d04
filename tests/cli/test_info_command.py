import json

import cv2
import numpy as np
import pytest

from oasis_warp.cli import main
from oasis_warp.hand_avatar import Avatar


def test_the_facts_are_those_of_the_avatar(avatar_file, tmp_path, capsys):
    assert main(["info", str(avatar_file), "--json", str(tmp_path / "facts.json")]) == 0
    facts = json.loads((tmp_path / "facts.json").read_text())[str(avatar_file)]
    avatar = Avatar.load(avatar_file)
    assert facts["side"] == avatar.side
    assert facts["n_gaussians"] == len(avatar.gaussians.opacities)
    assert facts["hand_licence"].startswith("CC0")
    assert 150 < facts["length_mm"] < 230 and 50 < facts["breadth_mm"] < 90
    assert str(facts["n_gaussians"]) in capsys.readouterr().out


def test_two_avatars_have_a_column_each_and_a_wrong_file_is_said(avatar_file, tmp_path, capsys):
    assert main(["info", str(avatar_file), str(avatar_file)]) == 0
    (tmp_path / "no.safetensors").write_text("no avatar")
    assert main(["info", str(avatar_file), str(tmp_path / "no.safetensors")]) == 2
    assert "no.safetensors: expected" in capsys.readouterr().err


def test_a_comparison_names_what_differs_and_nothing_else(scene, avatar_file, tmp_path, capsys):
    one, other = tmp_path / "one" / "avatar.safetensors", tmp_path / "other" / "avatar.safetensors"
    for path, seed, psnr in ((one, 0, 30.0), (other, 3, 31.5)):
        path.parent.mkdir()
        report = {"config": {"seed": seed, "size": 512}, "errors": {"input_psnr_db": psnr, "mask_iou": 0.9}}
        path.with_name("report.json").write_text(json.dumps(report))
    avatar = scene[2]
    avatar.save(one)
    avatar.with_looks(avatar.gaussians._replace(scales=0.9 * avatar.gaussians.scales), None).save(other)
    record = tmp_path / "record.json"
    assert main(["compare", str(one), str(other), "-o", str(tmp_path / "both.png"), "--json", str(record)]) == 0
    said = capsys.readouterr().out
    assert "--seed" in said and "--size" not in said and "31.5 dB" in said and "overlap of fit" not in said
    facts = json.loads(record.read_text())
    assert facts["different"]["--seed"] == ["0", "3"]
    assert facts["different"]["their median size"] == pytest.approx([3, 2.7])
    assert "side" not in facts["different"]
    assert all(20 < value < 60 for value in facts["likeness_db"])
    assert np.asarray(cv2.imread(str(tmp_path / "both.png"))).shape[1] == 1200


def test_an_avatar_differs_in_nothing_from_itself(avatar_file, tmp_path, capsys):
    record = tmp_path / "record.json"
    assert main(["compare", str(avatar_file), str(avatar_file), "--json", str(record)]) == 0
    assert capsys.readouterr().out.count("alike") == 3
    assert json.loads(record.read_text())["different"] == {}


def test_no_avatar_is_said(capsys):
    assert main(["info"]) == 2
    assert "expected at least one avatar.safetensors" in capsys.readouterr().err
