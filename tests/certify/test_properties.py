"""Laws of the operators on scenes of any seed, and that each check of certification finds what it looks for."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from oasis_warp import ops
from oasis_warp.certify.certification import (
    bit_differences,
    finite_differences,
    full_scene,
    outputs_and_gradients,
    refusals,
    small_scenes,
)
from oasis_warp.certify.families import FAMILIES
from oasis_warp.reference.errors import same_bits

SEEDS = st.integers(0, 2**31 - 1)
FEW = settings(max_examples=6, deadline=None, derandomize=True)
CPU = torch.device("cpu")
DIFFERENTIABLE = [name for name, family in FAMILIES.items() if next(iter(small_scenes(family, 0)), None)]
pytestmark = pytest.mark.usefixtures("as_shipped_once")
"""Thousands of small calls, and the type checks cost more than they do."""


@pytest.fixture(scope="module")
def as_shipped_once():
    """As `as_shipped`, for tests that hypothesis calls many times."""
    import jaxtyping

    was = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", was)


def arguments(name, seed, dtype=torch.float32, **options):
    made = FAMILIES[name].case("ordinary", seed, **options).arguments(dtype, CPU)
    return {k: v.detach() if isinstance(v, torch.Tensor) else v for k, v in made.items()}


def picture(seed, dtype=torch.float32, **options):
    """Arguments of the rasterizer with plain colours [N, 3], two cameras and backgrounds."""
    options = {"n": 25, "size": (17, 13), "mode": "RGB", "n_cameras": 2} | options
    given_ = arguments("rasterization", seed, dtype, **options)
    given_.pop("sh_degree", None)
    g = torch.Generator().manual_seed(seed)
    given_["colors"] = torch.rand(len(given_["means"]), 3, generator=g).to(dtype)
    given_["backgrounds"] = torch.rand(len(given_["viewmats"]), 3, generator=g).to(dtype)
    return given_


@FEW
@given(SEEDS)
def test_cameras_drawn_together_and_apart_give_the_same_bits(seed):
    scene = picture(seed)
    both = ops.rasterization(**scene)[0]
    for c in range(2):
        cameras = {k: scene[k][c : c + 1] for k in ("viewmats", "Ks", "backgrounds")}
        assert torch.equal(ops.rasterization(**scene | cameras)[0][0], both[c])


@FEW
@given(SEEDS)
def test_channels_drawn_together_and_apart_are_the_same(seed):
    scene = picture(seed)
    together = ops.rasterization(**scene)[0]
    for k in range(3):
        one = {name: scene[name][..., k : k + 1] for name in ("colors", "backgrounds")}
        torch.testing.assert_close(ops.rasterization(**scene | one)[0], together[..., k : k + 1], rtol=0, atol=1e-6)


@FEW
@given(SEEDS, st.floats(-3.0, 3.0, width=32))
def test_scaling_colours_and_background_scales_the_image(seed, factor):
    scene = picture(seed)
    scaled = {name: factor * scene[name] for name in ("colors", "backgrounds")}
    image, other = ops.rasterization(**scene)[0], ops.rasterization(**scene | scaled)[0]
    torch.testing.assert_close(other, factor * image, rtol=0, atol=1e-6 * max(1.0, abs(factor)))


@FEW
@given(SEEDS)
def test_a_larger_image_keeps_the_pixels_there_were(seed):
    # The Jacobian's clamp follows the size of the image; the principal point stays, and nothing here is that far out.
    scene = picture(seed, torch.float64)
    scene["means"] = 0.3 * scene["means"]
    small, large = ops.rasterization(**scene)[0], ops.rasterization(**scene | {"width": 30, "height": 21})[0]
    torch.testing.assert_close(large[:, :13, :17], small, rtol=0, atol=1e-12)


@FEW
@given(SEEDS)
def test_swapping_the_axes_of_the_image_transposes_it(seed):
    scene = picture(seed, torch.float64)
    swap = torch.tensor([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
    Ks = swap[:3, :3] @ scene["Ks"] @ swap[:3, :3]
    other = ops.rasterization(**scene | {"viewmats": swap @ scene["viewmats"], "Ks": Ks, "width": 13, "height": 17})[0]
    torch.testing.assert_close(other.transpose(1, 2), ops.rasterization(**scene)[0], rtol=0, atol=1e-10)


@FEW
@given(SEEDS)
def test_more_opacity_never_lowers_alpha_and_alpha_never_reaches_one(seed):
    scene = picture(seed, n=1)
    last = torch.zeros(())
    for opacity in torch.linspace(0.0, 1.0, 9):
        alphas = ops.rasterization(**scene | {"opacities": torch.full((1,), float(opacity))})[1]
        assert (alphas >= last).all() and (alphas < 1 - 1e-4).all()
        last = alphas


@FEW
@given(SEEDS)
def test_the_gradient_of_a_sum_is_the_sum_of_the_gradients(seed):
    scene = picture(seed, torch.float64)
    means = scene["means"].requires_grad_()
    image, alphas, _ = ops.rasterization(**scene)
    sums = image[0].sum(), image[1].sum(), alphas.sum()
    parts = [torch.autograd.grad(part, means, retain_graph=True)[0] for part in sums]
    (together,) = torch.autograd.grad(image.sum() + alphas.sum(), means)
    torch.testing.assert_close(sum(parts), together, rtol=1e-9, atol=1e-9)


@FEW
@given(SEEDS)
def test_faces_in_front_never_make_a_point_more_visible_nor_the_map_deeper(seed):
    scene = arguments("depth_visibility", seed, torch.float64, n=20, size=(31, 23), n_points=40)
    if scene["vertices"].dim() > 2 or scene["viewmat"].dim() > 2:
        scene |= {k: scene[k].view(-1, *scene[k].shape[-2:])[0] for k in ("vertices", "viewmat", "K")}
    scene.pop("point_vertices", None)
    few = scene | {"faces": scene["faces"][::2]}
    less, more = ops.depth_visibility(**few), ops.depth_visibility(**scene)
    assert (more.depth_map <= less.depth_map).all()
    assert ((more.visibility >= 0) & (more.visibility <= 1)).all()
    assert (more.visibility <= less.visibility + 1e-12).all()


@FEW
@given(SEEDS)
def test_a_mesh_in_two_parts_turns_and_carries_as_its_parts_do(seed):
    a, b = (arguments("face_rotations", s, torch.float64, side=3) for s in (seed, seed // 2 + 1))
    n = len(a["rest_vertices"])
    both = {k: torch.cat([a[k], b[k]]) for k in ("rest_vertices", "posed_vertices")}
    whole = ops.face_rotations(**both, faces=torch.cat([a["faces"], b["faces"] + n]))
    first, second = ops.face_rotations(**a), ops.face_rotations(**b)
    assert torch.equal(whole.vertex_quats, torch.cat([first.vertex_quats, second.vertex_quats]))
    assert torch.equal(whole.area_ratio, torch.cat([first.area_ratio, second.area_ratio]))


@FEW
@given(SEEDS)
def test_a_mirrored_pose_is_the_mirror_image_of_the_pose(seed):
    scene = arguments("face_rotations", seed, torch.float64, side=3)
    flip = torch.tensor([-1.0, 1, 1], dtype=torch.float64)
    mirrored = {k: scene[k] * flip for k in ("rest_vertices", "posed_vertices")}
    plain = ops.face_rotations(**scene)
    other = ops.face_rotations(**mirrored, faces=scene["faces"][:, [0, 2, 1]])
    # (w, x, y, z) mirrored in x is (w, x, -y, -z), up to the sign of the whole.
    expected = plain.face_quats * torch.tensor([1.0, 1, -1, -1])
    off = torch.minimum((other.face_quats - expected).norm(dim=1), (other.face_quats + expected).norm(dim=1))
    assert off.max() < 1e-12
    torch.testing.assert_close(other.vertex_area_ratio, plain.vertex_area_ratio)


@FEW
@given(SEEDS)
def test_skinning_by_one_transform_is_that_transform(seed):
    scene = arguments("skin", seed, torch.float64, n=20, n_joints=5, rotation_only=False, with_covars=True)
    one = scene["transforms"][:1].expand_as(scene["transforms"])
    moved = ops.skin(**scene | {"transforms": one})
    linear, shift = one[0, :3, :3], one[0, :3, 3]
    torch.testing.assert_close(moved.means, scene["means"] @ linear.T + shift)
    torch.testing.assert_close(moved.covars, linear @ scene["covars"] @ linear.T)


@pytest.mark.parametrize("repeats", [5, pytest.param(30, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FAMILIES)
def test_repeats_on_one_two_and_three_threads_give_the_same_bits(name, repeats, device):
    family = FAMILIES[name]
    found = bit_differences(family, family.case("ordinary", 1, **family.large), device, repeats)
    assert [m.scene.split(": ")[1] for m in found] == [f"{repeats} runs on {n} threads" for n in (1, 2, 3)]
    assert not [m for m in found if not m.passed]


@pytest.mark.parametrize("name", FAMILIES)
def test_other_calls_in_between_change_no_bit(name, device):
    family = FAMILIES[name]
    case, others = family.case("ordinary", 1, **family.large), [family.scene(seed) for seed in range(12)]
    first = outputs_and_gradients(family, case, device)
    for other in others:
        outputs_and_gradients(family, other, device)
        assert same_bits(first, outputs_and_gradients(family, case, device))


def fill_freed_memory(value):
    """Fill memory with `value` and free it: the next call gets some of it."""
    sizes = [2**k * m for k in range(15) for m in (1, 3, 9)]
    _ = [torch.full((size,), value) for size in sizes for _ in range(3)]


@pytest.mark.parametrize("name", FAMILIES)
def test_results_do_not_depend_on_what_memory_held_before(name):
    family = FAMILIES[name]
    for seed in range(45):
        case = family.scene(seed)
        fill_freed_memory(3e37)
        first = outputs_and_gradients(family, case, CPU)
        fill_freed_memory(-7.0)
        assert same_bits(first, outputs_and_gradients(family, case, CPU)), case


def test_one_bit_in_one_gradient_is_found(monkeypatch):
    family, calls = FAMILIES["pose_on_mesh"], []
    right = ops.pose_on_mesh

    def drifting(**arguments):
        calls.append(None)
        arguments["scales"] = arguments["scales"] * (1 + 6e-8 * (len(calls) > 3))
        return right(**arguments)

    monkeypatch.setattr(ops, "pose_on_mesh", drifting)
    found = bit_differences(family, family.case("ordinary", 0, n=7), CPU, 5)
    assert [m.error for m in found] == [3.0, 5.0, 5.0]


class Scaled(torch.autograd.Function):
    """The identity, with a derivative of `factor`."""

    @staticmethod
    def forward(ctx, tensor, factor):
        ctx.factor = factor
        return tensor.clone()

    @staticmethod
    def backward(ctx, grad):
        return ctx.factor * grad, None


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_a_gradient_that_is_off_by_a_millionth_is_found_and_no_other(name, monkeypatch):
    family = FAMILIES[name]
    case = next(small_scenes(family, 0))
    right = getattr(ops, name)
    for wrong in case.differentiable:
        with monkeypatch.context() as patch:
            patch.setattr(
                ops, name, lambda wrong=wrong, **given: right(**given | {wrong: Scaled.apply(given[wrong], 1 + 1e-6)})
            )
            found = finite_differences(family, case, CPU, n_directions=2)
        assert [m.scene.split(": ")[1] for m in found if not m.passed] == [wrong]


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_gradients_of_the_references_are_those_of_finite_differences(name):
    family = FAMILIES[name]

    class Reference:
        """The reference in the operator's place."""

        def __getattr__(self, attribute):
            return getattr(family, attribute)

        def call(self, arguments):
            return {k: v for k, v in arguments.items() if k != "validate"}

        def read(self, arguments):
            return family.reference(arguments, 1.0)[0]

    for case in small_scenes(family, 3):
        for m in finite_differences(Reference(), case, CPU, n_directions=1):
            assert m.passed, m


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_scenes_for_differences_are_smooth_and_cover_every_input(name):
    family = FAMILIES[name]
    cases = list(small_scenes(family, 0))
    assert all(family.smooth(case) for case in cases)
    floats = {key for case in cases for key in case.differentiable}
    assert floats == {key for seed in range(60) for key in family.scene(seed).differentiable}


def test_a_swap_of_two_layers_is_not_smooth():
    family = FAMILIES["rasterization"]
    case = next(small_scenes(family, 0))
    means = case.floats["means"].clone()
    means[1] = means[0]
    assert not family.smooth(dataclasses.replace(case, floats=case.floats | {"means": means}))


@pytest.mark.parametrize("name", FAMILIES)
def test_bad_values_shapes_and_indices_are_refused_by_name(name, device):
    family = FAMILIES[name]
    found = refusals(family, full_scene(family, 0), device)
    assert {m.check.split(" not ")[0] for m in found} >= {"NaN or Inf", "wrong shapes"}
    assert not [m for m in found if not m.passed]


def test_an_operator_that_does_not_check_values_is_found(monkeypatch):
    family = FAMILIES["face_rotations"]
    right = ops.face_rotations
    monkeypatch.setattr(ops, "face_rotations", lambda **given: right(**given, validate=False))
    found = refusals(family, full_scene(family, 0), CPU)
    assert sum(not m.passed for m in found if m.check.startswith("NaN")) == 6


@pytest.mark.parametrize("options", [{"mode": "D"}, {"mode": "RGB", "sh_degree": 2}])
def test_colors_that_are_not_numbers_are_refused_by_name_in_every_mode(options):
    family = FAMILIES["rasterization"]
    case = family.case("ordinary", 0, n=5, size=(5, 4), channels=3, **options)
    bad = case.floats["colors"].clone()
    bad.view(-1)[0] = torch.nan
    with pytest.raises(ValueError, match="^colors: "):
        family.call(case.arguments(torch.float32, CPU) | {"colors": bad.float()})
