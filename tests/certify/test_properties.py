"""Laws of the operators on scenes of any seed; those that need a scene of their own stand in tests/ops."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from oasis_warp import ops
from oasis_warp.certify.families import FAMILIES

SEEDS = st.integers(0, 2**31 - 1)
FEW = settings(max_examples=6, deadline=None, derandomize=True)
CPU = torch.device("cpu")
pytestmark = pytest.mark.usefixtures("as_shipped_once")


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
