import cv2
import numpy as np
import pytest
import torch

from oasis_warp.cli import main
from oasis_warp.core.errors import InputError
from oasis_warp.export import export_avatar
from oasis_warp.export.formats import WRITERS, choose_writer
from oasis_warp.hand_avatar import Avatar


@pytest.mark.parametrize("ending", WRITERS)
def test_the_longest_ending_chooses_the_writer_whatever_its_case(ending):
    assert choose_writer(f"some.folder/My.Hand{ending.upper()}") is WRITERS[ending]


@pytest.mark.parametrize("name", ["hand.xyz", "hand", ".ply"])
def test_an_unknown_ending_is_refused_and_the_known_ones_are_named(right_hand, tmp_path, name):
    with pytest.raises(InputError, match=r"expected a name that ends in .*\.ply"):
        export_avatar(right_hand, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_light_is_refused(right_hand, tmp_path, as_shipped):
    with pytest.raises(ValueError, match="light: expected one of 'baked', 'none', got 'moon'"):
        export_avatar(right_hand, tmp_path / "hand.ply", light="moon")


@pytest.mark.parametrize("ending", [".glb", ".ply", ".json", ".obj"])
def test_a_wrong_pose_is_refused_in_every_format(right_hand, ending, tmp_path, as_shipped):
    """Meshes with bones take its angles only, and would write what they give."""
    pose = right_hand.source_pose
    broken = pose.angles.clone()
    broken[3, 0] = torch.nan
    for angles, message in ((torch.zeros(2, 15, 3), r"expected shape \[15, 3\]"), (broken, "angles")):
        with pytest.raises(ValueError, match=message):
            export_avatar(right_hand, tmp_path / f"hand{ending}", pose=pose._replace(angles=angles))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [".glb", ".spz", ".obj", ".json"])
def test_avatars_on_a_device_or_with_gradients_are_the_same_files(left_hand, ending, device, tmp_path):
    left_hand.save(tmp_path / "avatar.safetensors")
    other = Avatar.load(tmp_path / "avatar.safetensors", device)
    colors = other.gaussians.colors.clone().requires_grad_()
    other = other.with_looks(other.gaussians._replace(colors=colors), other.light)
    for name, avatar in (("a", left_hand), ("b", other)):
        (tmp_path / name).mkdir()
        export_avatar(avatar, tmp_path / name / f"hand{ending}")
    assert (tmp_path / f"a/hand{ending}").read_bytes() == (tmp_path / f"b/hand{ending}").read_bytes()


def test_values_that_are_not_finite_never_leave(right_hand, tmp_path):
    """A file from before must stay, and nothing half-written beside it."""
    (tmp_path / "hand.ply").write_bytes(b"before")
    scales = right_hand.gaussians.scales.clone()
    scales[7] = torch.nan
    broken = right_hand.with_looks(right_hand.gaussians._replace(scales=scales), None)
    with pytest.raises(InputError, match="expected finite Gaussians, got 1 that are not"):
        export_avatar(broken, tmp_path / "hand.ply")
    assert (tmp_path / "hand.ply").read_bytes() == b"before"
    assert len(list(tmp_path.iterdir())) == 1


def test_huge_gaussians_are_held_to_the_width_of_a_finger(right_hand, tmp_path, caplog):
    from tests.export.splat_readers import READERS

    scales = right_hand.gaussians.scales.clone()
    scales[7] = 5.0
    broken = right_hand.with_looks(right_hand.gaussians._replace(scales=scales), None)
    export_avatar(broken, tmp_path / "hand.ply")
    assert READERS[".ply"](tmp_path / "hand.ply")[2].max() <= 0.0200001
    assert "1 of" in caplog.text and "20 mm" in caplog.text


def test_a_page_has_the_photo_beside_the_hand_and_other_formats_refuse_it(left_hand, tmp_path, capsys):
    left_hand.save(tmp_path / "avatar.safetensors")
    cv2.imwrite(str(tmp_path / "photo.png"), np.zeros((40, 36, 3), np.uint8))
    for name, code in (("hand.html", 0), ("hand.ply", 2)):
        given = ["-o", str(tmp_path / name), "--photo", str(tmp_path / "photo.png")]
        assert main(["export", str(tmp_path / "avatar.safetensors"), *given]) == code
    assert "hand.ply: has no room for --photo" in capsys.readouterr().err
    assert '<img id="photo"' in (tmp_path / "hand.html").read_text()


def test_the_command_writes_a_pose_in_a_light(left_hand, tmp_path):
    left_hand.save(tmp_path / "avatar.safetensors")
    out = tmp_path / "hand.ply"
    assert main(["export", str(tmp_path / "avatar.safetensors"), "-o", str(out)]) == 0
    plain = out.read_bytes()
    arguments = ["--pose", "fist", "--light", "none"]
    assert main(["export", str(tmp_path / "avatar.safetensors"), "-o", str(out), *arguments]) == 0
    assert len(out.read_bytes()) == len(plain) and out.read_bytes() != plain


def test_the_command_names_a_wrong_ending_before_it_reads_the_avatar(tmp_path, capsys):
    assert main(["export", str(tmp_path / "missing.safetensors"), "-o", str(tmp_path / "hand.doc")]) == 2
    assert "expected a name that ends in" in capsys.readouterr().err
