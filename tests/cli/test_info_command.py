import json

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


def test_no_avatar_is_said(capsys):
    assert main(["info"]) == 2
    assert "expected at least one avatar.safetensors" in capsys.readouterr().err
