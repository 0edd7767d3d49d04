import pytest
import torch

from oasis_warp.avatar.anchors import MIN_OPACITY, OPACITY, place_anchors, vertex_to_gaussians
from oasis_warp.core import rotation, surface
from oasis_warp.hand.skinning import rest_hand


@pytest.fixture(scope="module")
def rest(hand):
    return rest_hand(hand, torch.zeros(len(hand.shape_names)))


@pytest.fixture(scope="module")
def anchors(hand, rest):
    return place_anchors(hand, rest)


def test_nearly_every_vertex_and_face_carries_a_gaussian(hand, anchors):
    full = len(hand.template) + len(hand.faces)
    assert full == 36_945
    assert 0.98 * full < len(anchors.opacities) < full


def test_what_the_wrist_hides_is_left_out_and_the_rest_is_nearly_opaque(hand, anchors):
    assert float(anchors.opacities.min()) >= MIN_OPACITY
    assert not set(hand.rim.tolist()) & set(anchors.vertex_index.tolist())
    assert float((anchors.opacities > OPACITY - 1e-4).float().mean()) > 0.9


def test_gaussians_are_flat_along_the_surface(hand, rest, anchors):
    normals = surface.vertex_normals(rest.vertices, hand.faces)[anchors.vertex_index]
    frames = rotation.to_matrix(anchors.quats[: len(anchors.vertex_index)])
    torch.testing.assert_close(frames[:, :, 2], normals, atol=1e-5, rtol=0)
    assert bool((anchors.scales[:, 2] < anchors.scales[:, :2].amin(1)).all())
    assert float((anchors.scales.amax(1) / anchors.scales[:, 1]).max()) <= 3.01


def test_sizes_are_those_of_the_mesh(anchors):
    assert 3e-4 < float(anchors.scales[:, :2].median()) < 2e-3
    assert float(anchors.scales.max()) < 4e-3


def test_gaussians_grow_with_the_hand(hand, rest, anchors):
    twice = place_anchors(hand, rest._replace(vertices=2 * rest.vertices))
    common = torch.isin(twice.vertex_index, anchors.vertex_index)
    a = anchors.scales[: len(anchors.vertex_index)][torch.isin(anchors.vertex_index, twice.vertex_index)]
    torch.testing.assert_close(twice.scales[: len(twice.vertex_index)][common], 2 * a)


def test_a_field_over_the_vertices_is_read_at_centres(hand, rest, anchors):
    means = vertex_to_gaussians(rest.vertices, hand.faces, anchors)
    n = len(anchors.vertex_index)
    assert torch.equal(means[:n], rest.vertices[anchors.vertex_index])
    torch.testing.assert_close(means[n:], rest.vertices[hand.faces[anchors.face_index]].mean(1))
