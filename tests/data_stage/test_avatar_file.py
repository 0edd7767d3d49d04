import json
import math
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from oasis_warp.core.errors import InputError
from oasis_warp.data.avatar_file import (
    ALBEDO,
    FINE_SHADE,
    FORMAT,
    INVENTED,
    LIGHT,
    SHADE,
    TENSORS,
    UNITS,
    VERSION,
    load_avatar,
    save_avatar,
)
from oasis_warp.data.avatar_file import HEADER as FILE_HEADER

LIGHT_SHAPES = {"light.harmonics": (4, 3), "light.limits": (2, 3), "light.even": (3,)}
SIZES = {"S": 4, "V": 30, "P": 5, "Q": 7, "N": 12}
HAND = {"S": 4, "V": 30, "F": 50}
HEADER = {
    "side": "left",
    "hand_model": "bundled",
    "hand_licence": "CC0-1.0",
    "source_camera": {"width": 256, "height": 256},
}


@pytest.fixture
def tensors():
    generator = torch.Generator().manual_seed(3)
    made = {}
    for name, entry in TENSORS.items():
        shape = [SIZES.get(size, size) for size in entry.shape]
        if entry.dtype == torch.int64:
            made[name] = torch.randint(0, SIZES["V"], shape, generator=generator)
        else:
            share = torch.rand(shape, generator=generator)
            low, high = max(entry.low, 1e-3), min(entry.high, 1)
            made[name] = low + (high - low) * share
    made["gaussians.barycentrics"] /= made["gaussians.barycentrics"].sum(1, keepdim=True)
    for name, size in (("source_pose.orientation", 3), ("source_camera.viewmat", 4)):
        made[name] = torch.eye(size)
    made["source_camera.K"] = torch.tensor([[300.0, 0, 100], [0, 300, 128], [0, 0, 1]])
    return made


@pytest.fixture
def written(tmp_path, tensors):
    path = tmp_path / "avatar.safetensors"
    save_avatar(path, tensors, HEADER)
    return path


def rewrite(path, tensors=None, **changes):
    """Store other tensors or another header in the file, as a foreign program might."""
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()[FORMAT])
    save_file(load_file(path) if tensors is None else tensors, path, {FORMAT: json.dumps(header | changes)})


def test_an_avatar_comes_back_as_it_was(written, tensors):
    back, header = load_avatar(written)
    assert back.keys() == tensors.keys()
    assert all(torch.equal(back[name], tensors[name]) and back[name].dtype == tensors[name].dtype for name in tensors)
    assert {key: header[key] for key in HEADER} == HEADER
    assert header["units"] == UNITS
    assert header["counts"] == {"gaussians": 12, "on_vertices": 5, "on_faces": 7}
    assert header["creator"].startswith("oasis_warp ")


def test_tensors_that_carry_gradients_or_strides_are_stored(tmp_path, tensors):
    tensors["gaussians.colors"].requires_grad_()
    tensors["gaussians.offsets"] = tensors["gaussians.offsets"].T.contiguous().T
    save_avatar(tmp_path / "a.safetensors", tensors, HEADER)
    back, _ = load_avatar(tmp_path / "a.safetensors")
    assert torch.equal(back["gaussians.offsets"], tensors["gaussians.offsets"])


def test_the_same_avatar_is_the_same_file(tmp_path, tensors):
    save_avatar(tmp_path / "a", tensors, HEADER)
    save_avatar(tmp_path / "b", dict(reversed(tensors.items())), dict(reversed(HEADER.items())))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_nothing_wrong_is_ever_written(tmp_path, tensors):
    path = tmp_path / "a.safetensors"
    for bad in (
        {**tensors, "more": torch.zeros(1)},
        {**tensors, "gaussians.quats": torch.zeros(12, 4)},
        {**tensors, "gaussians.scales": torch.full((12, 3), torch.nan)},
        {**tensors, "source_camera.K": torch.eye(4)},
    ):
        with pytest.raises(ValueError, match=r"expected|unknown more"):
            save_avatar(path, bad, HEADER)
    with pytest.raises(ValueError, match="header: expected 'side' of type str, got None"):
        save_avatar(path, tensors, {**HEADER, "side": None})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("gaussians.scales", torch.full((12, 3), torch.nan), "scales: expected values from 1e-08 to 0.1, got 36 of 36"),
        ("gaussians.scales", torch.zeros(12, 3), "scales: expected values from 1e-08 to 0.1"),
        ("gaussians.offsets", torch.full((5, 3), torch.inf), "offsets: expected values.*such as inf"),
        ("gaussians.offsets", torch.ones(1, 3) / 20, r"offsets: expected shape \[5, 3\], got \[1, 3\]"),
        ("gaussians.quats", torch.zeros(12, 4), "quats: expected quaternions, about of length 1, got 12 bad"),
        ("gaussians.quats", torch.ones(12, 3), r"quats: expected shape \[N, 4\], got \[12, 3\]"),
        ("gaussians.opacities", torch.full((12,), 1.5), "opacities: expected values from 0 to 1"),
        ("gaussians.vertex_index", torch.full((5,), 30), "vertex_index: expected values from 0 to 29"),
        ("gaussians.face_index", torch.full((7,), -1), "face_index: expected values from 0"),
        ("gaussians.face_index", torch.full((7,), 50), "face_index: expected values from 0 to 49"),
        ("gaussians.face_index", torch.zeros(7), "face_index: expected torch.int64, got torch.float32"),
        ("gaussians.barycentrics", torch.full((7, 3), 0.5), "barycentrics: expected weights that sum to 1"),
        ("gaussians.colors", torch.ones(11, 3), r"colors: expected shape \[12, 3\]"),
        ("gaussians.colors", torch.full((12, 3), -1.0), "colors: expected values from -0.001"),
        ("shape", torch.full((4,), 1e14), "shape: expected values from -10 to 10"),
        ("shape", torch.zeros(5), r"shape: expected shape \[4\], got \[5\]"),
        ("surface_offsets", torch.zeros(1, 3), r"surface_offsets: expected shape \[30, 3\], got \[1, 3\]"),
        ("surface_offsets", torch.ones(30, 3), "surface_offsets: expected values from -0.05 to 0.05"),
        ("source_pose.orientation", -torch.eye(3), "orientation: expected a rotation"),
        ("source_camera.viewmat", torch.zeros(4, 4), "viewmat: expected a rotation and a shift"),
        ("source_camera.K", torch.eye(3, dtype=torch.float64), "K: expected torch.float32"),
        ("source_camera.K", torch.ones(3, 3), "K: expected a camera in pixels"),
    ],
)
def test_a_tensor_that_cannot_be_right_is_named(written, tensors, name, value, expected):
    rewrite(written, {**tensors, name: value})
    with pytest.raises(InputError, match=f"damaged avatar file.*{expected}"):
        load_avatar(written, {"bundled": HAND})


def test_rows_that_do_not_add_up_are_refused(written, tensors):
    tensors["gaussians.vertex_index"] = tensors["gaussians.vertex_index"][:4]
    tensors["gaussians.offsets"] = tensors["gaussians.offsets"][:4]
    rewrite(written, tensors)
    with pytest.raises(InputError, match=r"expected 4 \+ 7 rows, got 12"):
        load_avatar(written)


def test_a_missing_and_an_unknown_tensor_are_named(written, tensors):
    del tensors["shape"]
    rewrite(written, {**tensors, "extra": torch.zeros(2)})
    with pytest.raises(InputError, match="missing shape; unknown extra"):
        load_avatar(written)


def test_a_newer_version_is_refused_with_the_remedy(written):
    rewrite(written, version=VERSION + 1, side=None)
    with pytest.raises(InputError, match=f"version {VERSION + 1}.*update oasis-warp"):
        load_avatar(written)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"version": 0}, f"expected version 1 to {VERSION}, got 0"),
        ({"version": "1"}, "expected 'version' of type int, got '1'"),
        ({"side": "both"}, "expected side 'left' or 'right', got 'both'"),
        ({"hand_model": None}, "expected 'hand_model' of type str, got None"),
        ({"source_camera": {"width": 0, "height": 9}}, "positive width and height"),
        ({"source_camera": {"width": 46_340, "height": 46_340}}, "height up to 4096, got"),
        ({"source_camera": {"width": True, "height": 9}}, "positive width and height"),
        ({"source_camera": {"width": 9, "height": 9, "K": 3}}, "positive width and height"),
        ({"version": True}, "expected 'version' of type int"),
        ({"side": "l" * 100_000}, "expected side 'left' or 'right', got 'lll"),
    ],
)
def test_a_header_that_cannot_be_right_is_refused(written, changes, expected):
    rewrite(written, **changes)
    with pytest.raises(InputError, match=f"damaged avatar file.*{expected}"):
        load_avatar(written)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "1", "[" * 100_000, '{"version": NaN}', f'{{"version": {"1" * 5000}}}']
)
def test_a_header_that_is_no_json_object_is_refused(written, tensors, text):
    save_file(tensors, written, {FORMAT: text})
    with pytest.raises(InputError, match="damaged avatar file"):
        load_avatar(written)


def test_what_a_message_quotes_of_a_file_is_short_and_printable(written, tensors):
    rewrite(written, tensors | {f"\x1b[31m\n{k}": torch.zeros(1) for k in range(2000)})
    with pytest.raises(InputError, match="unknown") as caught:
        load_avatar(written)
    assert len(str(caught.value)) < 500
    assert str(caught.value).isprintable()
    rewrite(written, tensors, hand_model="h" * 100_000)
    with pytest.raises(InputError, match="which is not installed") as caught:
        load_avatar(written, {"bundled": HAND})
    assert len(str(caught.value)) < 500


def test_no_memory_is_taken_for_more_gaussians_than_a_hand_can_have(tmp_path):
    entries, place, n = {}, 0, 5_000_000
    for name, entry in TENSORS.items():
        kind = "I64" if entry.dtype == torch.int64 else "F32"
        shape = [{"P": n, "Q": 0, "N": n, "S": 4, "V": 30}.get(size, size) for size in entry.shape]
        size = entry.dtype.itemsize * math.prod(shape)
        entries[name] = {"dtype": kind, "shape": shape, "data_offsets": [place, place + size]}
        place += size
    header = {**HEADER, "version": VERSION}
    text = json.dumps({"__metadata__": {FORMAT: json.dumps(header)}, **entries}).encode()
    with (tmp_path / "huge").open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        file.truncate(8 + len(text) + place)  # a hole, which takes no room
    with pytest.raises(InputError, match="1 to 4000000, got 5000000"):
        load_avatar(tmp_path / "huge")


def test_another_safetensors_file_is_no_avatar(tmp_path):
    save_file({"weight": torch.zeros(2)}, tmp_path / "net.safetensors")
    with pytest.raises(InputError, match="a safetensors file, but not an avatar"):
        load_avatar(tmp_path / "net.safetensors")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.99])
def test_a_file_cut_short_is_refused(written, share):
    data = written.read_bytes()
    written.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match="another format or a file cut short"):
        load_avatar(written)


def test_another_format_is_refused(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n" + bytes(100))
    with pytest.raises(InputError, match="another format"):
        load_avatar(tmp_path / "a.ply")
    with pytest.raises(InputError, match="no such file"):
        load_avatar(tmp_path / "none")
    with pytest.raises(InputError, match="found a folder"):
        load_avatar(tmp_path)


def test_the_documentation_lists_every_tensor_and_header_key():
    page = (Path(__file__).parents[2] / "docs" / "avatar_file.md").read_text()
    for name, entry in (TENSORS | LIGHT | SHADE | FINE_SHADE | ALBEDO | INVENTED).items():
        shape = ", ".join(map(str, entry.shape))
        assert f"| `{name}` | {str(entry.dtype).removeprefix('torch.')} | {shape} |" in page
    for key in FILE_HEADER:
        assert f"| `{key}` |" in page


def test_light_comes_as_a_whole_or_not_at_all(tmp_path, tensors):
    light = {name: torch.rand(shape) + 0.1 for name, shape in LIGHT_SHAPES.items()}
    light["light.limits"] = torch.tensor([[0.5] * 3, [1.5] * 3])
    save_avatar(tmp_path / "lit", {**tensors, **light}, HEADER)
    back, _ = load_avatar(tmp_path / "lit")
    assert back.keys() == tensors.keys() | light.keys()
    light |= {"light.harmonics": torch.rand(9, 3), "light.albedo": torch.full((3,), 0.4)}
    save_avatar(tmp_path / "around", {**tensors, **light}, HEADER)
    assert load_avatar(tmp_path / "around")[0].keys() == tensors.keys() | light.keys()
    for change in (
        {"light.limits": light["light.limits"].flip(0)},
        {"light.limits": torch.zeros(2, 3)},
        {"light.limits": torch.full((2, 3), 1e30)},
        {"light.even": torch.zeros(3)},
        {"light.harmonics": torch.full((4, 3), torch.nan)},
        {"light.harmonics": torch.ones(5, 3)},
        {"light.albedo": torch.full((3,), 1.5)},
    ):
        with pytest.raises(ValueError, match=next(iter(change))):
            save_avatar(tmp_path / "bad", {**tensors, **light, **change}, HEADER)
    with pytest.raises(ValueError, match="missing light.even"):
        save_avatar(tmp_path / "bad", {**tensors, **{k: v for k, v in light.items() if k != "light.even"}}, HEADER)
    assert not (tmp_path / "bad").exists()


def test_shade_comes_with_light_as_a_whole_or_not_at_all(tmp_path, tensors):
    n = len(tensors["surface_offsets"])
    light = {name: torch.ones(shape) for name, shape in LIGHT_SHAPES.items()}
    shade = {"light.shade": torch.full((n, 3), 0.9), "light.facing": torch.eye(3)[torch.arange(n) % 3]}
    save_avatar(tmp_path / "shaded", {**tensors, **light, **shade}, HEADER)
    assert load_avatar(tmp_path / "shaded")[0].keys() == tensors.keys() | light.keys() | shade.keys()
    for change in (
        {"light.shade": torch.zeros(n, 3)},
        {"light.shade": torch.ones(n + 1, 3)},
        {"light.facing": torch.ones(n, 3)},
    ):
        with pytest.raises(ValueError, match=next(iter(change))):
            save_avatar(tmp_path / "bad", {**tensors, **light, **shade, **change}, HEADER)
    with pytest.raises(ValueError, match="missing light.facing"):
        save_avatar(tmp_path / "bad", {**tensors, **light, "light.shade": shade["light.shade"]}, HEADER)
    with pytest.raises(ValueError, match=r"missing light.even"):
        save_avatar(tmp_path / "bad", {**tensors, **shade}, HEADER)


def test_shade_of_gaussians_comes_with_that_of_vertices(tmp_path, tensors):
    n = len(tensors["surface_offsets"])
    light = {name: torch.ones(shape) for name, shape in LIGHT_SHAPES.items()}
    light |= {"light.shade": torch.ones(n, 3), "light.facing": torch.eye(3)[torch.arange(n) % 3]}
    fine = {"gaussians.shade": torch.full_like(tensors["gaussians.colors"], 0.9)}
    save_avatar(tmp_path / "shaded", {**tensors, **light, **fine}, HEADER)
    assert torch.equal(load_avatar(tmp_path / "shaded")[0]["gaussians.shade"], fine["gaussians.shade"])
    for change in (0 * fine["gaussians.shade"], fine["gaussians.shade"][1:]):
        with pytest.raises(ValueError, match=r"gaussians\.shade"):
            save_avatar(tmp_path / "bad", {**tensors, **light, "gaussians.shade": change}, HEADER)
    with pytest.raises(ValueError, match=r"missing light\.even"):
        save_avatar(tmp_path / "bad", {**tensors, **fine}, HEADER)


def test_what_is_invented_is_in_the_file_for_every_vertex_or_not_at_all(tmp_path, tensors):
    invented = torch.linspace(0, 1, len(tensors["surface_offsets"]))
    save_avatar(tmp_path / "painted", {**tensors, "invented": invented}, HEADER)
    assert torch.equal(load_avatar(tmp_path / "painted")[0]["invented"], invented)
    for bad in (invented + 0.5, invented[1:]):
        with pytest.raises(ValueError, match="invented"):
            save_avatar(tmp_path / "bad", {**tensors, "invented": bad}, HEADER)


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_an_older_file_is_read(written, version):
    rewrite(written, version=version)
    assert load_avatar(written)[1]["version"] == version
