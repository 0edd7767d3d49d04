import json

import cv2
import numpy as np
import pytest
import torch
from synthetic import as_left_hand

from oasis_warp import editing
from oasis_warp.avatar.prior import MeanPrior
from oasis_warp.cli import edit as edit_command
from oasis_warp.cli import main
from oasis_warp.core.camera import project
from oasis_warp.core.config import BLACK, EditConfig
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import HandLight, Photo
from oasis_warp.data.pictures import write_picture
from oasis_warp.data.square_crop import find_square
from oasis_warp.editing import edit
from oasis_warp.hand_avatar import Avatar
from studies.painted_truth import Chart, make_truth, paint_photo

QUICK = EditConfig(steps=10)


@pytest.fixture(scope="module")
def truth(hand):
    return make_truth(hand, MeanPrior(hand), back=False, size=224, steps=8)


@pytest.fixture(scope="module", autouse=True)
def each_photo_is_searched_once():
    found = {}

    def find_once(picture, alpha, photo):
        key = photo.numpy().tobytes()
        if key not in found:
            found[key] = find_square(picture, alpha, photo)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(editing, "find_square", find_once)
        yield


@pytest.fixture(scope="module")
def chart(truth):
    return Chart(truth, "ring")


@pytest.fixture(scope="module")
def painted(truth, chart):
    return paint_photo(truth, chart)


@pytest.fixture(scope="module")
def made(truth, painted):
    return edit(truth.avatar, painted, photo=truth.photo, config=QUICK)


def mask_of(chart) -> Photo:
    share = chart.rgba[..., 3].view(224, 4, 224, 4).mean((1, 3))
    return Photo((share[..., None].expand(-1, -1, 3) * 255).round().to(torch.uint8), None, None, "mask.png", 1.0)


def test_the_square_of_the_source_camera_is_found(truth, made):
    source, side = truth.avatar.source_camera, made.square.side
    scale = side / source.width
    assert scale * float(source.K[0, 0]) == pytest.approx(float(truth.camera.K[0, 0]), rel=0.005)
    found = made.square.left + scale * float(source.K[0, 2]), made.square.top + scale * float(source.K[1, 2])
    assert found == pytest.approx(truth.camera.K[:2, 2].tolist(), abs=0.7)


def test_the_paint_is_seen_and_the_rest_stays(made):
    measures = made.measures
    assert measures["input_psnr_db"] > 18
    assert measures["unchanged_psnr_db"] > 45
    assert 150 < measures["painted_mm2"] < 450  # a ring of 6 mm on half a finger, with its soft rim
    assert measures["n_gaussians"] == len(made.avatar.gaussians.opacities)
    assert not made.warnings


def test_the_avatar_given_is_not_changed(truth, made):
    assert len(truth.avatar.gaussians.opacities) < len(made.avatar.gaussians.opacities)
    assert torch.equal(truth.avatar.source_pose.angles, made.avatar.source_pose.angles)


def test_a_mask_replaces_the_photo(truth, chart, painted, made):
    masked = edit(truth.avatar, painted, mask=mask_of(chart), config=QUICK)
    assert masked.square.side == pytest.approx(made.square.side, rel=0.005)
    assert masked.measures["painted_mm2"] < made.measures["painted_mm2"]  # the difference has a rim around it
    assert masked.measures["input_psnr_db"] > 16


def test_photos_may_be_given_as_files_as_to_reconstruct(truth, painted, made, tmp_path, as_shipped):
    for name, photo in (("painted.png", painted), ("photo.png", truth.photo)):
        write_picture(tmp_path / name, photo.rgb)
    found = edit(truth.avatar, str(tmp_path / "painted.png"), photo=tmp_path / "photo.png", config=QUICK)
    assert torch.equal(found.avatar.gaussians.colors, made.avatar.gaussians.colors)
    with pytest.raises(TypeError, match="^mask: expected a Photo or its file, got int"):
        edit(truth.avatar, tmp_path / "painted.png", mask=3)


def test_a_transparent_layer_is_paint(truth, chart, made):
    share = mask_of(chart).rgb[..., 0].float() / 255
    layer = Photo(torch.full((224, 224, 3), 30, dtype=torch.uint8), share, None, "layer.png", 1.0)
    worn = edit(truth.avatar, layer, photo=truth.photo, config=QUICK)
    assert torch.allclose(worn.mask.max(), torch.tensor(1.0), atol=0.02)
    assert worn.measures["painted_mm2"] < made.measures["painted_mm2"]


def test_a_left_hand_is_the_mirror_image_of_a_right_one(truth, painted, made):
    avatar = truth.avatar
    left = as_left_hand(avatar)
    photos = (picture._replace(rgb=picture.rgb.flip(1).contiguous()) for picture in (painted, truth.photo))
    mirrored = edit(left, next(photos), photo=next(photos), config=QUICK)
    assert mirrored.measures["new_gaussians"] == pytest.approx(made.measures["new_gaussians"], rel=0.05)
    for name in ("painted_mm2", "input_psnr_db"):
        assert mirrored.measures[name] == pytest.approx(made.measures[name], rel=0.05)
    camera = avatar.source_camera
    right_view = made.avatar.render(camera, avatar.source_pose).image
    left_view = mirrored.avatar.render(left.source_camera, left.source_pose).image.flip(1)
    assert (right_view - left_view).abs().mean() < 2e-3


def test_without_photo_and_mask_nothing_is_guessed(truth, painted):
    with pytest.raises(InputError, match="also give the original photo, or a mask"):
        edit(truth.avatar, painted)


def test_a_photo_without_paint_is_refused(truth):
    with pytest.raises(InputError, match="there is no paint on the hand that differs from the photo"):
        edit(truth.avatar, truth.photo, photo=truth.photo)


def test_another_mistake_on_the_way_is_not_said_to_be_a_lack_of_paint(truth, painted, monkeypatch):
    def fail(*_):
        raise ValueError("pose.angles: expected finite values, got nan.")

    monkeypatch.setattr(editing, "skin", fail)
    with pytest.raises(ValueError, match=r"^pose\.angles: expected finite values"):
        edit(truth.avatar, painted, photo=truth.photo, config=QUICK)


def test_a_wholly_different_picture_is_not_said_to_lack_paint(truth):
    noise = torch.randint(0, 256, truth.photo.rgb.shape, generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    other = truth.photo._replace(rgb=noise, name="other.png")
    with pytest.raises(InputError, match=f"^other.png: does not match {truth.photo.name}; paint on a copy"):
        edit(truth.avatar, other, photo=truth.photo, config=QUICK)


def test_a_photo_of_something_else_is_refused(truth):
    noise = torch.randint(0, 256, (200, 260, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    other = Photo(noise, None, None, "noise.png", 1.0)
    with pytest.raises(InputError, match=r"noise\.png: does not match the avatar"):
        edit(truth.avatar, other, photo=other)


@pytest.fixture
def files(truth, painted, tmp_path):
    truth.avatar.save(tmp_path / "avatar.safetensors")
    for photo in (truth.photo, painted):
        cv2.imwrite(str(tmp_path / photo.name), photo.rgb.numpy()[..., ::-1])
    return tmp_path


def command(files, *more):
    given = [str(files / "avatar.safetensors"), str(files / "painted.png"), "--photo", str(files / "truth.png")]
    return main(["edit", *given, *(() if "--steps" in more else ("--steps", "5")), *more])


def test_the_command_writes_avatar_picture_and_report(files, capsys):
    assert command(files) == 0
    out = files / "avatar-painted.safetensors"
    report = json.loads(out.with_suffix(".json").read_text())
    assert report["measures"]["new_gaussians"] > 0
    assert report["seconds"]["total"] > 0
    assert np.asarray(cv2.imread(str(out.with_suffix(".png")))).shape[1] == 1600
    assert len(Avatar.load(out).gaussians.opacities) == report["measures"]["n_gaussians"]
    assert "skin painted" in capsys.readouterr().out


def test_nothing_is_overwritten_without_being_told(files, capsys):
    before = (files / "avatar.safetensors").read_bytes()
    assert command(files, "-o", str(files / "painted.safetensors")) == 2  # its summary would be painted.png
    assert "would replace an input" in capsys.readouterr().err
    assert command(files, "-o", str(files / "avatar.safetensors"), "--overwrite") == 2
    (files / "ring.json").write_text("{}")
    assert command(files, "-o", str(files / "ring.safetensors")) == 2
    assert "exists already; choose another name with --out, or give --overwrite" in capsys.readouterr().err
    assert (files / "avatar.safetensors").read_bytes() == before
    assert not (files / "ring.safetensors").exists()


def test_an_edit_that_fails_at_its_last_file_leaves_none(files, made, monkeypatch, capsys):
    def fail(self, path):
        raise InputError(f"{path}: no room left to write it; free some.")

    monkeypatch.setattr(Avatar, "save", fail)
    monkeypatch.setattr(edit_command, "edit", lambda *_, **__: made)
    monkeypatch.setattr(edit_command, "draw_edit", lambda *_: torch.zeros(8, 8, 3, dtype=torch.uint8))
    before = sorted(path.name for path in files.iterdir())
    assert command(files, "-o", str(files / "new" / "ring.safetensors")) == 2
    assert f"{files / 'new' / 'ring.safetensors'}: no room left" in capsys.readouterr().err
    assert sorted(path.name for path in files.iterdir()) == before


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["-o", "ring.ply"], "expected a name that ends in .safetensors"),
        (["--size", "8"], "--size 8: expected 64 to 4096 pixels"),
        (["--steps", "-1"], "--steps -1: expected 0 or more"),
    ],
)
def test_wrong_options_get_one_sentence(files, capsys, more, said):
    assert command(files, *more) == 2
    assert said in capsys.readouterr().err


def test_paint_is_worn_as_it_was_painted_whatever_the_light_of_the_photo(truth):
    """In the photo's view the edit shows the paint, in even light the paint without the photo's light."""
    bare = truth.avatar
    light = HandLight(torch.tensor([[0.45, 0.4, 0.35], *[[0.0] * 3] * 3]), torch.tensor([[0.1] * 3, [1.0] * 3]),
                      torch.ones(3))  # fmt: skip
    avatar = bare.with_looks(bare.gaussians, light)
    image, alpha = avatar.render(avatar.source_camera, avatar.source_pose, BLACK)
    ground = torch.tensor([0.3, 0.4, 0.35])
    before = image + (1 - alpha)[..., None] * ground
    size = len(before)
    patch = torch.zeros(size, size, dtype=torch.bool)
    palm = avatar.mesh(avatar.source_pose).vertices[avatar.hand.segment == 0]
    x, y = project(avatar.source_camera, palm)[0].mean(0).int()
    patch[y - 12 : y + 12, x - 12 : x + 12] = True
    paint = torch.tensor([0.2, 0.5, 0.3])

    def photo(picture, name):
        return Photo((255 * picture).round().to(torch.uint8), None, None, name, 1.0)

    after = edit(
        avatar, photo(torch.where(patch[..., None], paint, before), "painted.png"), photo=photo(before, "photo.png"),
        config=QUICK,
    ).avatar  # fmt: skip
    inner = torch.zeros_like(patch)
    inner[y - 7 : y + 7, x - 7 : x + 7] = True
    worn = after.render(avatar.source_camera, avatar.source_pose, BLACK).image[inner]
    torch.testing.assert_close(worn.median(0).values, paint, atol=0.02, rtol=0)
    even = after.in_even_light().render(avatar.source_camera, avatar.source_pose, BLACK).image[inner]
    expected = paint / torch.tensor([0.45, 0.4, 0.35]) ** (1 / 2.2)
    torch.testing.assert_close(even.median(0).values, expected, atol=0.03, rtol=0)
