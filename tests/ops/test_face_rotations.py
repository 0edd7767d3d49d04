"""Face and vertex rotations: known answers, laws, hard meshes; and meshes that were measured at rest."""

import math

import pytest
import torch
from operator_calls import gradients, mesh

from oasis_warp.core.rotation import from_axis_angle, from_matrix, multiply
from oasis_warp.core.types import HandPose
from oasis_warp.hand.skinning import corrective_coefficients, rest_hand, skin
from oasis_warp.ops import RestMesh, face_rotations, rest_mesh
from oasis_warp.reference import posing as reference


def angle_between(a, b):
    """Angle of the rotation between unit quaternions [rad], sign or none; exact for small and large ones."""
    a, b = a.double().cpu(), b.double().cpu()
    b = torch.where((a * b).sum(-1, keepdim=True) < 0, -b, b)
    return 4 * torch.atan2((a - b).norm(dim=-1), (a + b).norm(dim=-1))


def about(axis, angle):
    """Rotation matrix about `axis` by `angle`."""
    axis = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    return from_axis_angle(axis, torch.tensor(angle, dtype=torch.float64))


@pytest.mark.parametrize("angle", [0.0, 1e-4, 1.0, math.pi - 1e-3, math.pi - 1e-6, math.pi])
@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [1.0, -2, 3]])
def test_a_rigid_motion_turns_every_face_and_vertex_by_its_rotation(axis, angle, dtype):
    rest, _, faces = mesh(3, 4, torch.float64)
    turn = about(axis, angle)
    posed = rest @ turn.T + torch.tensor([0.3, -0.2, 0.5])
    got = face_rotations(rest.to(dtype), posed.to(dtype), faces)
    # The rounding of float32 vertices turns edges of length 1 by up to 3e-7, thin faces by more.
    tolerance = 1.4e-5 if dtype == torch.float32 else 1e-13
    assert angle_between(got.face_quats, from_matrix(turn)).max() < tolerance
    assert angle_between(got.vertex_quats, from_matrix(turn)).max() < tolerance
    torch.testing.assert_close(got.area_ratio, torch.ones_like(got.area_ratio), rtol=tolerance, atol=0)


def test_turning_the_posed_mesh_multiplies_from_the_left_and_the_rest_mesh_from_the_right():
    rest, posed, faces = mesh(4, 4, torch.float64)
    turn = about([1.0, 1, 0], 1.1)
    q = from_matrix(turn)
    plain = face_rotations(rest, posed, faces)
    left = face_rotations(rest, posed @ turn.T, faces)
    right = face_rotations(rest @ turn, posed, faces)
    for before, after, other in list(zip(plain, left, right, strict=True))[:2]:
        assert angle_between(multiply(q.expand_as(before), before), after).max() < 1e-13
        assert angle_between(multiply(before, q.expand_as(before)), other).max() < 1e-13


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_uniform_scaling_turns_nothing_and_squares_in_the_area(factor):
    rest, _, faces = mesh(5, 4, torch.float64)
    got = face_rotations(rest, factor * rest, faces)
    assert angle_between(got.vertex_quats, torch.tensor([1.0, 0, 0, 0])).max() < 1e-13
    # The damping pulls the ratio to one by its share of the area, 1e-6 and more for thin faces.
    torch.testing.assert_close(got.area_ratio, torch.full_like(got.area_ratio, factor**2), rtol=5e-5, atol=0)


@pytest.mark.parametrize("corners", [[1, 2, 0], [2, 0, 1], [0, 2, 1]])
def test_the_order_of_corners_changes_no_rotation(corners, dtype):
    rest, posed, faces = mesh(6, 4, dtype)
    plain, other = face_rotations(rest, posed, faces), face_rotations(rest, posed, faces[:, corners])
    tolerance = 2e-6 if dtype == torch.float32 else 1e-12
    assert angle_between(plain.face_quats, other.face_quats).max() < tolerance
    assert angle_between(plain.vertex_quats, other.vertex_quats).max() < tolerance


def test_the_order_of_faces_permutes_the_result_and_a_second_copy_of_them_changes_none():
    rest, posed, faces = mesh(7, 4, torch.float64)
    order = torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))
    plain = face_rotations(rest, posed, faces)
    shuffled = face_rotations(rest, posed, faces[order])
    assert torch.equal(plain.face_quats[order], shuffled.face_quats)
    assert angle_between(plain.vertex_quats, shuffled.vertex_quats).max() < 1e-13
    twice = face_rotations(rest, posed, torch.cat([faces, faces]))
    assert angle_between(plain.vertex_quats, twice.vertex_quats).max() < 1e-13


def test_a_sheared_face_turns_by_its_polar_factor():
    # Shear x += s y turns by -atan(s / 2), whatever the edges do one by one.
    rest = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    shear = torch.tensor([[1.0, 0.8, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    got = face_rotations(rest, rest @ shear.T, torch.tensor([[0, 1, 2]])).face_quats
    assert angle_between(got, from_matrix(about([0.0, 0, 1], -math.atan(0.4)))).max() < 1e-15


def test_the_area_ratio_of_a_vertex_is_that_of_its_faces_together():
    rest, posed, faces = mesh(3, 4, torch.float64)
    posed[faces[0]] = posed[faces[0]].mean(0)  # one collapses: it turns nothing but still counts
    got = face_rotations(rest, posed, faces).vertex_area_ratio
    before, after = (reference.planes(vertices, faces).area for vertices in (rest, posed))
    around = torch.stack([(faces == v).any(1) for v in range(len(rest))]).double()
    # The damping pulls ratios to one by its share of the area, 1e-6 and more for thin faces.
    torch.testing.assert_close(got, (around @ after) / (around @ before), rtol=1e-5, atol=1e-5)


def test_a_vertex_mean_weighs_faces_by_their_area_at_rest():
    # Two faces share vertex 0: area 3 stays, area 1 turns by a right angle and is blown up besides.
    rest = torch.tensor([[0.0, 0, 0], [3, 0, 0], [3, 2, 0], [-1, 0, 0], [-1, -2, 0]], dtype=torch.float64)
    posed = rest.clone()
    posed[3:] = 10 * rest[3:] @ about([0.0, 0, 1], math.pi / 2).T
    got = face_rotations(rest, posed, torch.tensor([[0, 1, 2], [0, 3, 4]])).vertex_quats[0]
    mean = 3 * torch.tensor([1.0, 0, 0, 0]) + torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
    torch.testing.assert_close(got, (mean / mean.norm()).double())


def test_a_sheet_rolled_more_than_once_has_no_seam():
    # Rotations pass 180 degrees twice: quaternions of neighbours come with opposite signs.
    n = 200
    along = torch.linspace(0, 10.5, n, dtype=torch.float64)
    rest = torch.cat([torch.stack([along, torch.full_like(along, y), 0 * along], 1) for y in (0.0, 0.1)])
    rolled = torch.stack([along.sin(), rest[n:, 1], 1 - along.cos()], 1)
    posed = torch.cat([rolled * torch.tensor([1.0, 0, 1]), rolled])
    a = torch.arange(n - 1)
    faces = torch.cat([torch.stack([a, a + 1, a + n], 1), torch.stack([a + 1, a + n + 1, a + n], 1)])
    got = face_rotations(rest.float(), posed.float(), faces).vertex_quats
    expected = torch.stack([from_matrix(about([0.0, 1, 0], -float(t))) for t in along]).repeat(2, 1)
    # A face's rotation is that of its middle, half a step of 0.053 rad from its vertices.
    assert angle_between(got, expected).max() < 0.03


@pytest.mark.parametrize("flat", ["rest", "posed"])
def test_a_face_without_area_has_no_weight_no_gradient_and_the_rotation_of_the_largest(flat):
    rest, _, faces = mesh(0, 4, torch.float64)
    turn = about([1.0, 1, 1], 2.0)
    posed = rest @ turn.T
    n = len(rest)
    line = torch.tensor([[9.0, 9, 0], [10, 10, 0], [11, 11, 0]], dtype=torch.float64)
    proper = torch.tensor([[9.0, 9, 0], [10, 9, 0], [11, 11, 0]], dtype=torch.float64)
    more_rest, more_posed = (line, proper) if flat == "rest" else (proper, line)
    all_faces = torch.cat([faces, torch.tensor([[n, n + 1, n + 2], [0, 0, 1], [3, 3, 3]])])
    leaf = torch.cat([posed, more_posed]).requires_grad_()
    got = face_rotations(torch.cat([rest, more_rest]), leaf, all_faces)
    plain = face_rotations(rest, posed, faces)
    assert torch.equal(got.vertex_quats[:n], plain.vertex_quats)
    assert angle_between(got.face_quats.detach(), from_matrix(turn)).max() < 1e-13
    assert angle_between(got.vertex_quats.detach(), from_matrix(turn)).max() < 1e-13
    weights = torch.randn(4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (grad,) = torch.autograd.grad((got.vertex_quats @ weights).sum() + (got.face_quats @ weights).sum(), leaf)
    assert grad.isfinite().all() and not grad[n:].any() and grad[:n].any()
    (grad,) = torch.autograd.grad(face_rotations(torch.cat([rest, more_rest]), leaf, all_faces).area_ratio.sum(), leaf)
    assert grad.isfinite().all()


def test_lonely_vertices_points_and_empty_meshes_have_the_identity():
    identity = torch.tensor([1.0, 0, 0, 0])
    nothing = torch.zeros(0, 3, dtype=torch.int64)
    for rest, faces in [
        (torch.rand(5, 3), nothing),
        (torch.zeros(0, 3), nothing),
        (torch.ones(4, 3), torch.tensor([[0, 1, 2], [1, 2, 3]])),
    ]:
        leaf = rest.clone().requires_grad_()
        got = face_rotations(rest, leaf, faces)
        assert got.vertex_quats.shape == (len(rest), 4) and got.face_quats.shape == (len(faces), 4)
        assert (got.vertex_quats == identity).all() and (got.face_quats == identity).all()
        assert (got.area_ratio == 1).all()
        (grad,) = torch.autograd.grad(sum(out.sum() for out in got), leaf)
        assert grad.shape == leaf.shape and not grad.any()


def test_faces_changed_in_place_are_looked_at_again():
    rest, posed, faces = mesh(1, 4, torch.float64)
    face_rotations(rest, posed, faces)
    faces[0] = faces[5]
    changed = face_rotations(rest, posed, faces)
    assert torch.equal(changed.face_quats[0], changed.face_quats[5])
    fresh = face_rotations(rest, posed, faces.clone())
    assert torch.equal(changed.vertex_quats, fresh.vertex_quats)
    faces[0, 0] = -1
    with pytest.raises(ValueError, match=r"^faces: "):
        face_rotations(rest, posed, faces)


def test_a_bent_finger_of_the_hand_turns_by_the_rotation_of_its_bone(hand):
    rest = rest_hand(hand, torch.zeros(hand.shape_basis.shape[2]))
    angles = torch.zeros(15, 3)
    angles[0:3, 0] = 0.6  # the index finger flexes at its three joints
    posed = skin(hand, rest, HandPose(angles, about([0.0, 0, 1], 0.7).float(), torch.tensor([0.1, 0, 0.4])))
    # Pose correctives bend the skin at rest; what skinning then adds is the bones' rotation.
    corrected = rest.vertices + hand.corrective_basis @ corrective_coefficients(hand, angles)
    got = face_rotations(corrected, posed.vertices, hand.faces)
    firm = hand.weights.amax(1) > 0.999  # a vertex and its whole neighbourhood follow one bone
    index_tip = firm & (hand.segment == 3)
    axis = hand.pose_axes[1:4, 0]
    bend = [from_axis_angle(a, torch.tensor(0.6)) for a in axis]
    bone = from_matrix(about([0.0, 0, 1], 0.7).float() @ bend[0] @ bend[1] @ bend[2])
    assert index_tip.sum() > 50
    assert angle_between(got.vertex_quats[index_tip], bone).median() < 1e-3
    assert got.vertex_quats.isfinite().all() and (got.area_ratio > 0).all()


@pytest.mark.parametrize("n", [1, 3, 17])
def test_a_mesh_measured_at_rest_poses_like_its_vertices(n, dtype, device):
    rest, posed, faces = (part.to(device) for part in mesh(2, n, dtype))
    leaf = posed.clone().requires_grad_()
    plain, measured = face_rotations(rest, leaf, faces), face_rotations(rest_mesh(rest, faces), leaf, faces)
    assert all(torch.equal(a, b) for a, b in zip(plain, measured, strict=True))
    assert torch.equal(*(gradients(rotated, [leaf])[0] for rotated in (plain, measured)))


def test_a_mesh_measured_at_rest_may_have_flat_faces_and_points(device):
    rest, posed, faces = (part.to(device) for part in mesh(2, 2, torch.float32))
    rest[faces[0]] = rest[faces[0, 0]].clone()
    rest[faces[3, 1]] = (rest[faces[3, 0]] + rest[faces[3, 2]]) / 2
    plain, measured = (face_rotations(r, posed, faces) for r in (rest, rest_mesh(rest, faces)))
    for a, b in zip(plain, measured, strict=True):
        assert a.isfinite().all() and torch.equal(a, b)


def test_a_mesh_measured_at_rest_gets_no_gradient():
    rest, posed, faces = mesh(2, 2, torch.float32)
    still = rest_mesh(rest.requires_grad_(), faces)
    rotated = face_rotations(still, posed.requires_grad_(), faces)
    (grad,) = torch.autograd.grad(rotated.vertex_quats.sum(), posed)
    assert grad.any() and not still.vertices.requires_grad and not still.triangles.requires_grad


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        (RestMesh(torch.zeros(9, 2), torch.zeros(8, 12)), r"rest_vertices: expected shape \[V, 3\], got \[9, 2\]."),
        (RestMesh(torch.zeros(9, 3), torch.zeros(7, 12)), r"rest_vertices.triangles: expected shape \[8, 12\], got"),
        (
            RestMesh(torch.zeros(9, 3), torch.zeros(8, 12).double()),
            "rest_vertices.triangles: expected torch.float32 on cpu, got torch.float64 on cpu.",
        ),
    ],
)
def test_a_rest_mesh_of_something_else_is_refused(rest, message, as_shipped):
    _, posed, faces = mesh(0, 2, torch.float32)
    with pytest.raises(ValueError, match="^" + message):
        face_rotations(rest, posed, faces)


def test_a_rest_mesh_of_values_that_are_not_finite_is_refused():
    rest, _, faces = mesh(0, 2, torch.float32)
    rest[2, 1] = torch.nan
    with pytest.raises(ValueError, match="^rest_vertices: expected finite values .* got 1 of 27"):
        rest_mesh(rest, faces)
