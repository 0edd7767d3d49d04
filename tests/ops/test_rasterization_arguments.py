"""What the rasterizer refuses, and how it says so."""

import pytest
import torch
from rasterization_scenes import ordinary_scene

from oasis_warp.ops import rasterization

pytestmark = pytest.mark.usefixtures("as_shipped")
POISON = float("nan"), float("inf"), -float("inf"), 1e30


@pytest.fixture
def call():
    scene = ordinary_scene(0)
    arguments = {
        "means": scene.means, "quats": scene.quats, "scales": scene.scales, "opacities": scene.opacities,
        "colors": scene.colors, "viewmats": scene.viewmats, "Ks": scene.Ks, "width": 37, "height": 29,
        "backgrounds": scene.backgrounds,
    }  # fmt: skip

    def change(**changes):
        return rasterization(**{**arguments, **changes})

    change.arguments = arguments
    return change


def test_validate_false_skips_the_look_at_values(call):
    colors = call.arguments["colors"].clone()
    colors[0, 0] = float("nan")
    image, _, _ = call(colors=colors, validate=False)
    assert image[..., 0].isnan().any() and not image[..., 1:].isnan().any()


@pytest.mark.parametrize("value", POISON)
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "viewmats", "Ks"])
def test_unchecked_values_that_are_not_finite_do_not_reach_other_gaussians(name, value, call):
    bad = call.arguments[name].clone().double()
    bad.view(-1)[1] = value
    doubles = {k: v.double() for k, v in call.arguments.items() if isinstance(v, torch.Tensor)}
    for precision in (torch.float32, torch.float64):
        arguments = {k: v.to(precision) for k, v in {**doubles, name: bad}.items()}
        image, alphas, _ = call(**arguments, validate=False)
        assert torch.isfinite(image).all() and torch.isfinite(alphas).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"quats": torch.zeros(59, 4)}, r"quats: expected shape \[60, 4\], got \[59, 4\]. One wxyz row"),
        ({"colors": torch.zeros(1, 60, 3)}, r"colors: expected shape \[2, 60, D\], got \[1, 60, 3\]"),
        ({"colors": torch.zeros(60, 33), "backgrounds": None}, r"colors: expected 1 to 32 channels, got 33"),
        ({"colors": torch.zeros(60, 0), "backgrounds": None}, r"colors: expected 1 to 32 channels, got 0"),
        ({"viewmats": torch.eye(4)}, r"viewmats: expected shape \[C, 4, 4\], got \[4, 4\]. A single camera"),
        ({"quats": torch.zeros(60, 4)}, r"quats: expected rows that are not zero, got 60 zero rows"),
        ({"opacities": torch.full((60,), 1.5)}, r"opacities: expected values in \[0, 1\], got 1.5 to 1.5. Logits"),
        ({"opacities": torch.full((60,), -0.5)}, r"opacities: expected values in \[0, 1\], got -0.5"),
        ({"Ks": torch.zeros(2, 3, 3)}, r"Ks: expected focal lengths other than 0"),
        ({"width": 0}, r"width: expected a whole number of pixels from 1 to 8388608, got 0"),
        ({"height": -3}, r"height: expected a whole number of pixels from 1 to 8388608, got -3"),
        ({"height": 2.0}, r"height: expected a whole number of pixels from 1 to 8388608, got 2.0"),
        ({"tile_size": 0}, r"tile_size: expected a whole number of pixels"),
        ({"width": 2**16, "height": 2**15}, r"width: expected at most 2147483647 pixels .* got 2 x 32768 x 65536"),
        ({"near_plane": 0.0}, r"near_plane: expected a positive finite number, got 0.0"),
        ({"far_plane": 0.001}, r"far_plane: expected more than near_plane, 0.01, got 0.001"),
        ({"eps2d": -0.1}, r"eps2d: expected a finite variance, at least 0, got -0.1"),
        ({"eps2d": float("nan")}, r"eps2d: expected a finite variance"),
        ({"radius_clip": float("nan")}, r"radius_clip: expected a number of pixels, at least 0, got nan"),
        ({"render_mode": "depth"}, r"render_mode: expected one of 'RGB', 'D', 'ED', 'RGB\+D', 'RGB\+ED', got 'depth'"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused_with_what_was_expected(changes, message, call):
    with pytest.raises(ValueError, match="^" + message):
        call(**changes)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sparse_grad", True), ("distributed", True),
        ("with_ut", True), ("with_eval3d", True),
        ("radial_coeffs", torch.zeros(2, 6)), ("tangential_coeffs", torch.zeros(2, 2)),
        ("thin_prism_coeffs", torch.zeros(2, 4)), ("ftheta_coeffs", object()), ("rolling_shutter", "LEFT_TO_RIGHT"),
        ("viewmats_rs", torch.zeros(2, 4, 4)),
    ],
)  # fmt: skip
def test_arguments_of_gsplat_that_are_not_built_in_are_refused_by_name(name, value, call):
    with pytest.raises(ValueError, match=rf"^{name}: expected .* Not supported in this version\. "):
        call(**{name: value})


def test_arguments_of_gsplat_at_their_defaults_change_nothing(call):
    plain = call()[0]
    defaults = {
        "sh_degree": None, "packed": True, "sparse_grad": False, "absgrad": False, "rasterize_mode": "classic",
        "channel_chunk": 32, "distributed": False, "camera_model": "pinhole", "segmented": False,
        "with_ut": False, "with_eval3d": False, "radial_coeffs": None, "tangential_coeffs": None,
        "thin_prism_coeffs": None, "ftheta_coeffs": None, "viewmats_rs": None,
    }  # fmt: skip
    assert torch.equal(call(**defaults)[0], plain)
    assert torch.equal(call(packed=False, segmented=True, channel_chunk=8)[0], plain)


def test_positions_of_the_arguments_are_those_of_gsplat(call):
    a = call.arguments
    first = [a[k] for k in ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height")]
    by_position = rasterization(*first, 0.02, 1e4, 0.0, 0.4, None, False, 8, a["backgrounds"], "RGB+D")
    by_name = call(near_plane=0.02, far_plane=1e4, eps2d=0.4, tile_size=8, render_mode="RGB+D")
    assert torch.equal(by_position[0], by_name[0])


def test_saved_tensors_that_were_copied_are_refused(call):
    means = call.arguments["means"].clone().requires_grad_()
    with torch.autograd.graph.saved_tensors_hooks(torch.clone, lambda tensor: tensor):
        image, _, _ = call(means=means)
    with pytest.raises(RuntimeError, match="rasterization: expected the tensors that it saved, got copies"):
        image.sum().backward()
