"""Gaussians carried by a posed mesh: twin, gradients, laws, hard cases, poison values, messages."""

import gc
import math
import weakref

import pytest
import torch

from oasis_warp.core.rotation import from_axis_angle, multiply, to_matrix
from oasis_warp.core.types import HandPose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.ops import face_rotations, pose_on_mesh
from oasis_warp.reference import posing as twin

LAWS = ["sqrt_area", "area", "none"]
FLOATS = ("posed_vertices", "barycentrics", "vertex_quats", "area_ratio", "quats", "scales")


def scene(seed, n_gaussians=40, dtype=torch.float64, device="cpu"):
    """Faces that share vertices at random, rotations anywhere on the sphere with random signs."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    n_vertices, n_faces = 14, 11
    floats = {
        "posed_vertices": normal(n_vertices, 3),
        "barycentrics": normal(n_gaussians, 3).softmax(-1),
        "vertex_quats": torch.nn.functional.normalize(normal(n_vertices, 4), dim=1),
        "area_ratio": normal(n_faces).exp(),
        "quats": torch.nn.functional.normalize(normal(n_gaussians, 4), dim=1),
        "scales": normal(n_gaussians, 3).exp(),
    }
    faces = torch.stack([torch.randperm(n_vertices, generator=generator)[:3] for _ in range(n_faces)])
    # The last face carries nothing, others carry several, in no order.
    face_index = torch.randint(n_faces - 1, (n_gaussians,), generator=generator)
    moved = {name: tensor.to(device, dtype) for name, tensor in floats.items()}
    return moved | {"faces": faces.to(device), "face_index": face_index.to(device)}


def rel(a, b):
    """Relative L2 distance."""
    return (a.double().cpu() - b).norm() / b.norm()


def assert_equals_twin(ours, floats, law, seed, dtype):
    """Values, and gradients by all `floats` of a random sum."""
    theirs = {k: v.cpu().double() if v.is_floating_point() else v.cpu() for k, v in ours.items()}
    for name in floats:
        ours[name].requires_grad_()
        theirs[name].requires_grad_()
    got = pose_on_mesh(**ours, scale_law=law)
    want = twin.pose_on_mesh(**theirs, scale_law=law)
    tolerance = 2e-7 if dtype == torch.float32 else 1e-14
    generator = torch.Generator().manual_seed(seed)
    loss = twin_loss = 0
    for a, b in zip(got, want, strict=True):
        assert a.dtype == dtype and rel(a.detach(), b.detach()) < tolerance
        weights = torch.randn(b.shape, generator=generator, dtype=torch.float64)
        loss, twin_loss = loss + (a * weights.to(a)).sum(), twin_loss + (b * weights).sum()
    grads = torch.autograd.grad(loss, [ours[name] for name in floats])
    twin_grads = torch.autograd.grad(twin_loss, [theirs[name] for name in floats])
    for name, a, b in zip(floats, grads, twin_grads, strict=True):
        if name.endswith("area_ratio") and law == "none":
            assert not a.any()
        else:
            assert rel(a, b) < 10 * tolerance, name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("seed", range(2))
def test_values_and_gradients_are_those_of_the_twin(seed, law, dtype, device):
    assert_equals_twin(scene(seed, dtype=dtype, device=device), FLOATS, law, seed, dtype)


def with_vertices(arguments, seed=0, n=9):
    """`arguments` of a scene with Gaussians on vertices, several on some, in front."""
    generator = torch.Generator().manual_seed(100 + seed)
    like, n_vertices = arguments["quats"], len(arguments["posed_vertices"])

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(like)

    return arguments | {
        "quats": torch.cat([normal(n, 4), arguments["quats"]]),
        "scales": torch.cat([normal(n, 3).exp(), arguments["scales"]]),
        "vertex_index": torch.randint(n_vertices - 3, (n,), generator=generator).to(like.device),
        "offsets": normal(n, 3),
        "vertex_area_ratio": normal(n_vertices).exp(),
    }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("n", [1, 9, 50])
def test_gaussians_on_vertices_come_first_and_are_those_of_their_twin(n, law, dtype, device):
    ours = with_vertices(scene(n, dtype=dtype, device=device), n, n)
    assert_equals_twin(ours, (*FLOATS, "offsets", "vertex_area_ratio"), law, n, dtype)


def test_gaussians_on_vertices_alone_need_no_barycentrics():
    arguments = with_vertices(scene(4))
    both = pose_on_mesh(**arguments)
    for name, n in {"face_index": 0, "barycentrics": 0, "quats": 9, "scales": 9}.items():
        arguments[name] = arguments[name][:n]
    got = pose_on_mesh(**arguments)
    assert len(got.means) == 9 and all(torch.equal(a, b[:9]) for a, b in zip(got, both, strict=True))


def test_another_mesh_for_the_same_gaussians_is_noticed():
    # Who hangs on which vertex is remembered with `face_index`, but follows from the faces too.
    arguments = with_vertices(scene(5))
    arguments["posed_vertices"].requires_grad_()
    weights = torch.arange(49.0)[:, None].double()

    def gradient(arguments):
        return torch.autograd.grad((pose_on_mesh(**arguments).means * weights).sum(), arguments["posed_vertices"])[0]

    before = gradient(arguments)
    fresh = {"face_index": arguments["face_index"].clone()}
    for change in ({"faces": arguments["faces"].flip(1)}, {"vertex_index": arguments["vertex_index"].flip(0)}):
        changed = gradient(arguments | change)
        assert not torch.equal(changed, before)
        assert torch.equal(changed, gradient(arguments | change | fresh))
    arguments["faces"][:] = arguments["faces"].flip(1).clone()
    assert torch.equal(gradient(arguments), gradient(arguments | fresh))


def on_a_sheet(seed, dtype=torch.float64):
    """A rest and a posed mesh and Gaussians on it, as the avatar has them: rotations come from `face_rotations`."""
    generator = torch.Generator().manual_seed(seed)
    n = 5
    y, x = torch.meshgrid(torch.arange(n + 1.0), torch.arange(n + 1.0), indexing="ij")
    rest = torch.stack([x, y, 0.3 * torch.rand(n + 1, n + 1, generator=generator)], -1).reshape(-1, 3).to(dtype)
    a = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + n + 2], 1), torch.stack([a, a + n + 2, a + n + 1], 1)])
    q = 2 * len(faces)
    return rest, faces, {
        "face_index": torch.arange(q) % len(faces),
        "barycentrics": torch.randn(q, 3, generator=generator).to(dtype).softmax(-1),
        "quats": torch.nn.functional.normalize(torch.randn(q, 4, generator=generator).to(dtype), dim=1),
        "scales": torch.randn(q, 3, generator=generator).to(dtype).exp(),
    }


def carry(rest, posed, faces, gaussians, law="sqrt_area"):
    turned = face_rotations(rest, posed, faces)
    return pose_on_mesh(
        posed, faces, vertex_quats=turned.vertex_quats, area_ratio=turned.area_ratio, scale_law=law, **gaussians
    )


def some_turn(seed=0):
    return to_matrix(torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


@pytest.mark.parametrize("law", LAWS)
def test_the_rest_pose_gives_the_canonical_set_back(law):
    rest, faces, gaussians = on_a_sheet(0)
    got = carry(rest, rest, faces, gaussians, law)
    torch.testing.assert_close(got.quats, gaussians["quats"], rtol=0, atol=1e-14)
    torch.testing.assert_close(got.scales, gaussians["scales"], rtol=1e-14, atol=0)


@pytest.mark.parametrize("law", LAWS)
def test_a_rigid_motion_acts_rigidly_on_means_and_rotations_and_leaves_scales(law):
    rest, faces, gaussians = on_a_sheet(1)
    turn, shift = some_turn(), torch.tensor([1.0, -2, 0.5], dtype=torch.float64)
    still, moved = carry(rest, rest, faces, gaussians, law), carry(rest, rest @ turn.T + shift, faces, gaussians, law)
    torch.testing.assert_close(moved.means, still.means @ turn.T + shift)
    torch.testing.assert_close(to_matrix(moved.quats), turn @ to_matrix(still.quats))
    torch.testing.assert_close(moved.scales, still.scales)


@pytest.mark.parametrize(("law", "power"), [("sqrt_area", 1), ("area", 2), ("none", 0)])
def test_uniform_growth_by_k_multiplies_scales_by_k_with_the_root_of_the_area(law, power):
    rest, faces, gaussians = on_a_sheet(2)
    k = 3.0
    got = carry(rest, k * rest, faces, gaussians, law)
    # The ratio is damped by 0.5e-6 of the longest edge squared, 1e-6 and a little of these faces' areas.
    torch.testing.assert_close(got.scales, k**power * gaussians["scales"], rtol=4e-6, atol=0)
    torch.testing.assert_close(got.quats, gaussians["quats"], rtol=0, atol=1e-13)


def test_a_corner_gives_that_vertex_and_its_rotation():
    arguments = scene(3, n_gaussians=30)
    corner = torch.arange(30) % 3
    arguments["barycentrics"] = torch.eye(3, dtype=torch.float64)[corner]
    got = pose_on_mesh(**arguments)
    vertex = arguments["faces"][arguments["face_index"], corner]
    assert torch.equal(got.means, arguments["posed_vertices"][vertex])
    torch.testing.assert_close(got.quats, multiply(arguments["vertex_quats"][vertex], arguments["quats"]))


def test_means_lie_inside_their_triangles():
    arguments = scene(4)
    means = pose_on_mesh(**arguments).means
    a, b, c = arguments["posed_vertices"][arguments["faces"][arguments["face_index"]]].unbind(1)
    areas = [torch.linalg.cross(p - means, q - means).norm(dim=1) for p, q in ((a, b), (b, c), (c, a))]
    torch.testing.assert_close(sum(areas), torch.linalg.cross(b - a, c - a).norm(dim=1))


def test_the_order_of_faces_and_corners_does_not_matter():
    arguments = scene(5)
    plain = pose_on_mesh(**arguments)
    order = torch.randperm(len(arguments["faces"]), generator=torch.Generator().manual_seed(0))
    other = dict(arguments)
    other["faces"], other["area_ratio"] = arguments["faces"][order], arguments["area_ratio"][order]
    other["face_index"] = order.argsort()[arguments["face_index"]]
    assert all(torch.equal(a, b) for a, b in zip(plain, pose_on_mesh(**other), strict=True))
    turned = dict(arguments)
    turned["faces"], turned["barycentrics"] = arguments["faces"][:, [1, 2, 0]], arguments["barycentrics"][:, [1, 2, 0]]
    for a, b in zip(plain, pose_on_mesh(**turned), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-14)


def test_the_sign_of_a_vertex_rotation_does_not_matter():
    arguments = scene(6)
    plain = pose_on_mesh(**arguments)
    flipped = dict(arguments)
    flipped["vertex_quats"] = arguments["vertex_quats"] * torch.tensor([1.0, -1]).repeat(7)[:, None]
    for a, b in zip(plain, pose_on_mesh(**flipped), strict=True):
        same = torch.minimum((a - b).norm(dim=1), (a + b).norm(dim=1)) if a.shape[1] == 4 else (a - b).norm(dim=1)
        assert same.max() < 1e-14


def test_opposite_rotations_mix_to_a_rotation_and_never_to_zero():
    # Corners turned by 0, 179.9 and -179.9 degrees about one axis, and by half turns about three.
    degrees = [0.0, 179.9, -179.9]
    about_z = [[math.cos(math.radians(d / 2)), 0, 0, math.sin(math.radians(d / 2))] for d in degrees]
    half_turns = [[0.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    quats = torch.tensor(about_z + half_turns, requires_grad=True)
    generator = torch.Generator().manual_seed(0)
    barycentrics = torch.rand(200, 3, generator=generator) + 1e-3
    barycentrics = (barycentrics / barycentrics.sum(1, keepdim=True)).requires_grad_()
    got = pose_on_mesh(
        torch.rand(6, 3, generator=generator),
        torch.tensor([[0, 1, 2], [3, 4, 5]]),
        torch.arange(200) % 2,
        barycentrics,
        quats,
        torch.ones(2),
        torch.tensor([[1.0, 0, 0, 0]]).expand(200, 4),
        torch.ones(200, 3),
    ).quats
    assert ((got.norm(dim=1) - 1).abs() < 2e-6).all()
    by_quats, by_barycentrics = torch.autograd.grad((got * torch.arange(4)).sum(), [quats, barycentrics])
    assert by_quats.isfinite().all() and by_barycentrics.isfinite().all()
    # |sum| is at least a third, and derivatives of the normalised mean at most its inverse.
    assert by_barycentrics.abs().max() < 3 * 10


def test_a_collapsed_or_torn_face_bounds_the_scale_and_stops_its_gradient():
    arguments = scene(8, n_gaussians=4)
    arguments["face_index"] = torch.tensor([0, 1, 2, 3])
    arguments["area_ratio"][:4] = torch.tensor([0.0, 1e-9, 1e9, 4.0], dtype=torch.float64)
    arguments["area_ratio"].requires_grad_()
    got = pose_on_mesh(**arguments)
    growth = (got.scales / arguments["scales"]).detach()
    expected = torch.tensor([1e-2, 1e-2, 1e2, 2.0], dtype=torch.float64)
    torch.testing.assert_close(growth, expected[:, None].expand(4, 3))
    (grad,) = torch.autograd.grad(got.scales.sum(), arguments["area_ratio"])
    assert not grad[:3].any() and grad[3] > 0


def test_barycentrics_that_sum_to_zero_leave_no_nan():
    arguments = scene(9, n_gaussians=2)
    arguments["barycentrics"] = torch.zeros(2, 3, dtype=torch.float64)
    for name in FLOATS:
        arguments[name].requires_grad_()
    got = pose_on_mesh(**arguments)
    assert all(out.isfinite().all() for out in got)
    grads = torch.autograd.grad(sum(out.sum() for out in got), [arguments[name] for name in FLOATS])
    assert all(grad.isfinite().all() for grad in grads)


@pytest.mark.parametrize("unit", [1e-9, 1e3, 1e12])
def test_the_unit_of_length_does_not_matter(unit):
    rest, faces, gaussians = on_a_sheet(3, dtype=torch.float32)
    posed = rest @ some_turn().float().T + 0.1 * rest.roll(1, 0)
    one = carry(rest, posed, faces, gaussians)
    scaled = carry(unit * rest, unit * posed, faces, gaussians | {"scales": unit * gaussians["scales"]})
    for a, b, factor in zip(one, scaled, (unit, 1, unit), strict=True):
        torch.testing.assert_close(factor * a, b, rtol=1e-4, atol=2e-6 * factor)


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
def test_an_index_is_remembered_no_longer_than_it_lives(dtype):
    arguments = scene(1)
    index = arguments.pop("face_index").to(dtype)
    first = pose_on_mesh(**arguments, face_index=index)
    assert torch.equal(first.means, pose_on_mesh(**arguments, face_index=index).means)
    gone = weakref.ref(index)
    del index, first
    gc.collect()
    assert gone() is None


def test_indices_made_in_inference_mode_are_accepted():
    with torch.inference_mode():
        arguments = scene(1)
        got = pose_on_mesh(**arguments)
    assert torch.equal(got.means, pose_on_mesh(**scene(1)).means)


def test_gaussians_on_the_hand_follow_a_bent_finger(hand):
    rest = rest_hand(hand, torch.zeros(hand.shape_basis.shape[2]))
    angles = torch.zeros(15, 3)
    angles[0:3, 0] = 0.6
    turn = from_axis_angle(torch.tensor([0.0, 0, 1]), torch.tensor(0.7))
    posed = skin(hand, rest, HandPose(angles, turn, torch.tensor([0.1, 0, 0.4])))
    n_faces = len(hand.faces)
    gaussians = {
        "face_index": torch.arange(n_faces),
        "barycentrics": torch.full((n_faces, 3), 1 / 3),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).expand(n_faces, 4),
        "scales": torch.full((n_faces, 3), 0.001),
    }
    got = carry(rest.vertices, posed.vertices, hand.faces, gaussians)
    torch.testing.assert_close(got.means, posed.vertices[hand.faces].mean(1), rtol=0, atol=1e-7)
    assert ((got.quats.norm(dim=1) - 1).abs() < 2e-6).all()
    assert (got.scales > 0.0001).all() and (got.scales < 0.01).all()
    # Faces that no joint of the index finger moves just turn with the wrist.
    corrected = hand.corrective_basis[..., :6].abs().amax((1, 2))
    still = ((hand.weights[:, 1:4].sum(1) < 1e-6) & (corrected < 1e-6))[hand.faces].all(1)
    assert still.sum() > 500
    turned = to_matrix(got.quats[still])
    torch.testing.assert_close(turned, turn.expand_as(turned), rtol=0, atol=2e-3)


def test_a_hand_is_posed_the_same_by_any_number_of_threads(hand, with_threads):
    generator = torch.Generator().manual_seed(0)
    rest, n_faces = hand.template, len(hand.faces)
    posed = (rest + 2e-4 * torch.randn(rest.shape, generator=generator)).requires_grad_()
    leaves = [
        posed,
        torch.randn(n_faces, 3, generator=generator).softmax(-1).requires_grad_(),
        torch.randn(n_faces, 4, generator=generator).requires_grad_(),
    ]
    weights = torch.randn(n_faces, 10, generator=generator)

    def carry_and_back():
        turned = face_rotations(rest, posed, hand.faces)
        got = pose_on_mesh(
            posed, hand.faces, torch.arange(n_faces), leaves[1], turned.vertex_quats, turned.area_ratio, leaves[2],
            torch.ones(n_faces, 3),
        )  # fmt: skip
        return [*got, *torch.autograd.grad((torch.cat([*got], 1) * weights).sum(), leaves)]

    one, several = with_threads(1, carry_and_back), with_threads(3, carry_and_back)
    assert all(torch.equal(a, b) for a, b in zip(one, several, strict=True))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale_law": "jacobian"}, "scale_law: expected one of 'sqrt_area', 'area', 'none', got 'jacobian'."),
        ({"posed_vertices": torch.zeros(14, 4).double()}, r"posed_vertices: expected shape \[V, 3\], got \[14, 4\]."),
        ({"faces": torch.zeros(11, 2).long()}, r"faces: expected shape \[F, 3\], got \[11, 2\]."),
        ({"faces": torch.full((11, 3), 14)}, r"faces: expected indices in 0 .. 13 \(14 vertices\)"),
        ({"face_index": torch.zeros(40, 1).long()}, r"face_index: expected shape \[Q\], got \[40, 1\]. One face"),
        ({"face_index": torch.full((40,), -1)}, r"face_index: expected indices in 0 .. 10 \(11 faces\), got values"),
        ({"face_index": torch.full((40,), 11)}, r"face_index: expected indices in 0 .. 10 \(11 faces\)"),
        ({"face_index": torch.zeros(40)}, "face_index: expected int32 or int64, got float32."),
        ({"barycentrics": torch.zeros(39, 3).double()}, r"barycentrics: expected shape \[40, 3\], got \[39, 3\]."),
        ({"vertex_quats": torch.zeros(14, 3).double()}, r"vertex_quats: expected shape \[14, 4\].*wxyz"),
        ({"area_ratio": torch.zeros(12).double()}, r"area_ratio: expected shape \[11\], got \[12\]. One ratio a face."),
        ({"quats": torch.zeros(40, 3).double()}, r"quats: expected shape \[40, 4\], got \[40, 3\].*wxyz"),
        ({"scales": torch.zeros(40, 3)}, "scales: expected torch.float64 on cpu, got torch.float32 on cpu."),
        ({"offsets": torch.zeros(9, 3).double()}, "offsets: expected None, got a tensor. It goes with vertex_index."),
        ({"vertex_index": torch.zeros(9).long()}, "offsets: expected a tensor, got None. It goes with vertex_index."),
    ],
)
def test_a_wrong_argument_is_named_with_what_was_expected(change, message, as_shipped):
    with pytest.raises(ValueError, match="^" + message):
        pose_on_mesh(**scene(0) | change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertex_index": torch.zeros(9, 1).long()}, r"vertex_index: expected shape \[P\], got \[9, 1\]. One vertex a"),
        ({"vertex_index": torch.full((9,), 14)}, r"vertex_index: expected indices in 0 .. 13 \(14 vertices\)"),
        ({"offsets": torch.zeros(8, 3).double()}, r"offsets: expected shape \[9, 3\], got \[8, 3\]."),
        ({"offsets": torch.full((9, 3), math.nan).double()}, "offsets: expected finite values"),
        ({"vertex_area_ratio": torch.zeros(13).double()}, r"vertex_area_ratio: expected shape \[14\], got \[13\]."),
        ({"quats": torch.zeros(40, 4).double()}, r"quats: expected shape \[49, 4\], got \[40, 4\]."),
    ],
)
def test_a_wrong_argument_of_gaussians_on_vertices_is_named(change, message, as_shipped):
    with pytest.raises(ValueError, match="^" + message):
        pose_on_mesh(**with_vertices(scene(0)) | change)


def test_without_validation_values_go_through_and_indices_do_not():
    arguments = scene(1)
    for a, b in zip(pose_on_mesh(**arguments), pose_on_mesh(**arguments, validate=False), strict=True):
        assert torch.equal(a, b)
    arguments["scales"][0] = math.nan
    assert pose_on_mesh(**arguments, validate=False).scales[0].isnan().all()
    arguments["face_index"][0] = 11
    with pytest.raises(ValueError, match="^face_index: "):
        pose_on_mesh(**arguments, validate=False)
