"""The references against second oracles: closed forms, the SVD, SciPy, naive formulas, and the torch peers."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from oasis_warp.bench import scenes
from oasis_warp.bench.operators import OPERATORS, draw_in_torch, exact, forward, with_gradients
from oasis_warp.certify.case import Sampler
from oasis_warp.certify.families import FAMILIES
from oasis_warp.core.rotation import from_axis_angle, from_matrix, to_matrix
from oasis_warp.core.types import Camera
from oasis_warp.reference import posing, rasterization, visibility
from oasis_warp.reference.errors import largest_error, psnr, relative_error, same_bits
from oasis_warp.reference.rasterization import Rules

DOUBLE = torch.float64
EYE = torch.eye(4, dtype=DOUBLE)


def arguments(name, seed, **options):
    case = FAMILIES[name].case("ordinary", seed, **options)
    made = case.arguments(DOUBLE, torch.device("cpu"))
    return {k: v.detach() if isinstance(v, torch.Tensor) else v for k, v in made.items()}


@pytest.mark.parametrize("seed", range(5))
def test_the_rasterizer_equals_its_naive_form(seed):
    given = arguments("rasterization", seed, n=30, size=(13, 9), n_cameras=1, channels=3, mode="RGB")
    given.pop("sh_degree", None)
    given["colors"] = given["colors"].reshape(-1, given["colors"].shape[-1])[:30, :3]
    K, viewmat = given["Ks"][0], given["viewmats"][0]
    image, alphas, _ = rasterization.rasterization(**given | {"backgrounds": None}, dense=True)
    # The inverse of the covariance, layer after layer, pixel after pixel.
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    points = given["means"] @ R.T + t
    order = points[:, 2].argsort()
    for y, x in ((0, 0), (4, 6), (8, 12), (5, 3)):
        left, color = 1.0, torch.zeros(3, dtype=DOUBLE)
        for i in order:
            X, Y, Z = points[i]
            limits = [(-K[k, 2] / K[k, k] - 0.15 * n / K[k, k], (n - K[k, 2]) / K[k, k] + 0.15 * n / K[k, k])
                      for k, n in ((0, 13), (1, 9))]  # fmt: skip
            u, v = (min(max(p / Z, low), high) for p, (low, high) in zip((X, Y), limits, strict=True))
            J = torch.tensor([[K[0, 0] / Z, 0, -K[0, 0] * u / Z], [0, K[1, 1] / Z, -K[1, 1] * v / Z]], dtype=DOUBLE)
            half = to_matrix(given["quats"][i]) @ torch.diag(given["scales"][i])
            covariance = J @ R @ half @ half.T @ R.T @ J.T + rasterization.GSPLAT.rounded()[2] * torch.eye(2)
            d = torch.tensor([x + 0.5 - K[0, 0] * X / Z - K[0, 2], y + 0.5 - K[1, 1] * Y / Z - K[1, 2]], dtype=DOUBLE)
            alpha = float(given["opacities"][i] * torch.exp(-0.5 * d @ torch.linalg.inv(covariance) @ d))
            alpha = min(alpha, rasterization.ALPHA_MAX)
            if alpha < rasterization.ALPHA_MIN:
                continue
            if left * (1 - alpha) <= rasterization.TRANSMITTANCE_STOP:
                break
            color += left * alpha * given["colors"][i]
            left *= 1 - alpha
        torch.testing.assert_close(image[0, y, x], color, rtol=0, atol=1e-12)
        torch.testing.assert_close(alphas[0, y, x, 0], torch.tensor(1 - left, dtype=DOUBLE), rtol=0, atol=1e-12)


def test_two_layers_have_their_closed_form():
    alpha = torch.tensor([[0.6, 0.3]], dtype=DOUBLE)
    weights, after = rasterization.blend(rasterization.Matrix(alpha))
    torch.testing.assert_close(weights, torch.tensor([[0.6, 0.12]], dtype=DOUBLE))
    torch.testing.assert_close(after, torch.tensor([[0.4, 0.28]], dtype=DOUBLE))


def test_the_layer_that_would_end_a_pixel_is_not_drawn_nor_any_behind_it():
    alpha = torch.tensor([[0.99, 0.98, 0.6, 0.5]], dtype=DOUBLE)  # T: 1e-2, 2e-4, 8e-5, ...
    weights, _ = rasterization.blend(rasterization.Matrix(alpha))
    assert weights[0, 1] > 0 and not weights[0, 2:].any()
    torch.testing.assert_close(1 - weights.sum(-1), torch.tensor([2e-4], dtype=DOUBLE))


@pytest.mark.parametrize("seed", range(4))
def test_face_rotations_are_the_polar_factors_of_an_svd(seed):
    rest, posed, faces = arguments("face_rotations", seed, side=4).values()
    frames = []
    for vertices in (rest, posed):
        a, b, c = vertices[faces].unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        frames.append(torch.stack([b - a, c - a, normal / normal.norm(dim=-1, keepdim=True)], -1))
    u, _, vt = torch.linalg.svd(frames[1] @ torch.linalg.inv(frames[0]))
    got = posing.face_rotations(rest, posed, faces).face_quats
    torch.testing.assert_close(to_matrix(got), u @ vt, rtol=0, atol=1e-12)
    torch.testing.assert_close(got, from_matrix(u @ vt), rtol=0, atol=1e-12)


def test_vertex_rotations_are_close_to_the_mean_of_scipy():
    rest, _, faces = arguments("face_rotations", 1, side=4).values()
    draw = Sampler(0)
    posed = rest + 0.03 * draw.normal(*rest.shape)
    vertex_quats, face_quats, *_ = posing.face_rotations(rest, posed, faces)
    areas = posing.planes(rest, faces).area
    for v in range(len(rest)):
        around = (faces == v).any(1)
        turns = Rotation.from_quat(face_quats[around].numpy(), scalar_first=True)
        mean = turns.mean(weights=areas[around].numpy())
        spread = float((mean.inv() * turns).magnitude().max())
        off = (mean.inv() * Rotation.from_quat(vertex_quats[v].numpy(), scalar_first=True)).magnitude()
        assert off <= 0.2 * spread**3 + 1e-12


def test_the_depth_buffer_sees_a_sphere_and_a_plane_where_they_are():
    polar = torch.linspace(0.0, math.pi, 60, dtype=DOUBLE)[:, None]
    around = torch.linspace(0.0, 2 * math.pi, 120, dtype=DOUBLE)[None]
    ball = torch.stack([polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos().expand(-1, 120)], -1)
    index = torch.arange(60 * 120).view(60, 120)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = torch.cat([torch.stack([a, b, c], -1).view(-1, 3), torch.stack([a, c, d], -1).view(-1, 3)])
    vertices = ball.reshape(-1, 3) + torch.tensor([0.0, 0.0, 4.0])
    K = torch.tensor([[20.0, 0, 6], [0, 20, 5], [0, 0, 1]], dtype=DOUBLE)
    depth = visibility.depth_map(vertices, faces, Camera(EYE, K, 12, 10)).depth
    y, x = torch.meshgrid(torch.arange(10).double() + 0.5, torch.arange(12).double() + 0.5, indexing="ij")
    ray = torch.stack([(x - 6) / 20, (y - 5) / 20, torch.ones_like(x)], -1)
    # |z ray - centre| = 1
    dot, square = 4 * ray[..., 2], ray.square().sum(-1)
    root = dot**2 - square * 15
    seen = root > 0.3
    torch.testing.assert_close(depth[seen], ((dot - root.clamp(min=0).sqrt()) / square)[seen], rtol=2e-3, atol=0)
    floor = torch.tensor([[-300.0, 0.5, -300], [300, 0.5, -300], [0, 0.5, 900]], dtype=DOUBLE)
    depth = visibility.depth_map(floor, torch.tensor([[0, 1, 2]]), Camera(EYE, K, 12, 10)).depth
    assert depth[:5].isinf().all()
    torch.testing.assert_close(depth[5:], (0.5 / ray[5:, :, 1]), rtol=1e-12, atol=0)


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_are_those_of_scipy(degree):
    directions = Sampler(2).normal(50, 3)
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            value = sph_harm_y(n, abs(m), polar, azimuth)
            columns.append(value.real if m == 0 else math.sqrt(2) * (value.imag if m < 0 else value.real))
    torch.testing.assert_close(rasterization.sh_basis(degree, directions), torch.from_numpy(np.stack(columns, -1)))


def test_a_rotation_is_its_own_nearest_one_and_its_adjoint_is_finite():
    turns = from_axis_angle(torch.tensor([[0.6, 0.8, 0.0]] * 3, dtype=DOUBLE), torch.tensor([0.0, 1.0, 3.0]).double())
    leaf = turns.clone().requires_grad_()
    nearest = posing.nearest_rotations(leaf)
    torch.testing.assert_close(nearest.detach(), turns)
    assert torch.autograd.grad((nearest * torch.arange(9.0).view(3, 3)).sum(), leaf)[0].isfinite().all()


def test_posing_at_a_corner_follows_that_vertex():
    given = arguments("pose_on_mesh", 3, n=9)
    n = len(given["quats"]) - 9
    given["barycentrics"] = torch.eye(3, dtype=DOUBLE).repeat(3, 1)
    means, quats, _ = posing.pose_on_mesh(**given)
    corner = given["faces"][given["face_index"], torch.arange(9) % 3]
    torch.testing.assert_close(means[n:], given["posed_vertices"][corner])
    expected = to_matrix(given["vertex_quats"][corner]) @ to_matrix(given["quats"][n:])
    torch.testing.assert_close(to_matrix(quats[n:]), expected)


def test_relative_error_is_norm_over_norm_where_judged():
    exact = torch.tensor([3.0, 4.0, 100.0])
    got = torch.tensor([3.0, 4.5, 0.0])
    judged = torch.tensor([True, True, False])
    assert relative_error(got, exact, judged) == 0.1
    assert largest_error(got, exact) == 100


def test_relative_error_of_nothing():
    zero = torch.zeros(2)
    assert relative_error(zero, zero) == 0
    assert relative_error(zero + 1, zero) == math.inf


def test_psnr_of_a_tenth_is_twenty_decibels():
    image = torch.zeros(4, 4, 3, dtype=torch.float64)
    assert math.isclose(psnr(image + 0.1, image), 20)
    assert psnr(image, image) == math.inf


def test_bits_tell_what_equality_does_not():
    one = torch.tensor([1.0, 0.0])
    assert same_bits([one], [one.clone()])
    assert not same_bits([one], [torch.tensor([1.0, -0.0])])
    assert not same_bits([one], [one.double()])
    assert not same_bits([one], [torch.nextafter(one, torch.tensor(2.0))])
    assert not same_bits([one], [])
    nan = torch.tensor([math.nan])
    assert same_bits([nan], [nan])


@pytest.fixture(scope="module")
def hand():
    return scenes.hand_scenes(size=48)


def agree(name, scene, values=1e-12, slopes=1e-11):
    operator, truth = OPERATORS[name], exact(OPERATORS[name], scene)
    wide = operator.prepare(scene.to(dtype=torch.float64))
    outputs = operator.comparable(forward(operator.torch_call, wide, {}))
    for ours, theirs in zip(truth.values, outputs, strict=True):
        assert relative_error(theirs, ours) <= values
    if operator.leaves:
        found = with_gradients(operator, operator.torch_call, wide, {}, truth.weights)().gradients
        for ours, theirs in zip(truth.gradients, found, strict=True):
            assert relative_error(theirs, ours) <= slopes


@pytest.mark.parametrize("make", [scenes.layered, scenes.needles, scenes.opaque, scenes.equal_depths])
def test_kernels_and_torch_draw_the_same_stiff_scenes(make):
    # A needle's determinant cancels 11 digits in the torch peer's gradient.
    agree("rasterization", make(size=32), values=1e-8, slopes=1e-5)


def test_kernels_and_torch_draw_the_same_hand(hand):
    agree("rasterization", hand[0])
    agree("blend_weights", hand[0])
    agree("blend_colors", hand[0])


@pytest.mark.parametrize("name", ["face_rotations", "pose_on_mesh", "posing"])
def test_kernels_and_torch_pose_the_same(hand, name):
    agree(name, hand[1])


@pytest.mark.parametrize("name", ["depth_map", "depth_visibility"])
def test_kernels_and_torch_see_the_same(hand, name):
    # A triangle of the hand is a thousandth of its distance: torch's cross products of corners cancel some digits.
    agree(name, hand[1], values=1e-5, slopes=1e-5)


@pytest.mark.parametrize(
    ("rules", "decibels"),
    [
        (Rules(transmittance_stop=1e-2), (42, 50)),
        (Rules(transmittance_stop=1e-3), (60, 72)),
        (Rules(alpha_min=2 / 255), (51, 58)),
        (Rules(alpha_min=4 / 255), (44, 50)),
        (Rules(extent_sigmas=3.0), (58, 66)),
        (Rules(extent_sigmas=2.5), (43, 50)),
        (Rules(extent_sigmas=2.0), (32, 38)),
    ],
)
def test_a_coarser_threshold_costs_what_theory_says(rules, decibels):
    # A layer below the cut has at most alpha 4/255; the tail beyond k sigma at most exp(-k^2/2): 1 to 14 % of a layer.
    scene = scenes.layered().to(dtype=torch.float64)
    low, high = decibels
    assert low <= psnr(draw_in_torch(scene, rules).image, draw_in_torch(scene).image) <= high


def test_fragile_pixels_are_those_where_float32_may_decide_otherwise():
    scene = scenes.frontal(
        "one", 0, torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1),
        torch.tensor([1.0]), torch.ones(1, 3), 32,
    ).to(dtype=torch.float64)  # fmt: skip
    # The opacity is chosen so that the alpha of one pixel lies on the cut, and then a hundredth beside it.
    alpha = draw_in_torch(replace(scene, opacities=scene.opacities * 0.5)).alphas[0, 10, 10, 0] * 2
    on_the_cut = float(Rules().alpha_min / alpha)
    for factor, fragile in ((1.0, True), (1.01, False), (0.99, False)):
        drawn = draw_in_torch(replace(scene, opacities=scene.opacities * on_the_cut * factor))
        assert bool(drawn.fragile[0, 10, 10]) == fragile


def test_an_empty_view_is_background():
    scene = scenes.layered(n=5, size=16)
    behind = replace(scene, means=-scene.means)
    drawn = draw_in_torch(behind)
    assert torch.equal(drawn.image, scene.backgrounds[0].expand(1, 16, 16, 3))
    assert not drawn.alphas.any()
    assert not drawn.fragile.any()
