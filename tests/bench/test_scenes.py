import pytest
import torch

from oasis_warp.bench import scenes
from oasis_warp.bench.torch_rasterizer import draw
from oasis_warp.reference.errors import relative_error

MAKERS = {
    "hand": lambda seed: scenes.hand(32, seed),
    "surfels": lambda seed: scenes.surfels(500, 32, seed),
    "far hand": lambda seed: scenes.far_hand(32, seed)[0],
    "layered": lambda seed: scenes.layered(seed=seed),
    "needles": lambda seed: scenes.needles(seed=seed),
    "opaque": lambda seed: scenes.opaque(seed=seed),
    "equal depths": lambda seed: scenes.equal_depths(seed=seed),
}


@pytest.mark.parametrize("name", MAKERS)
def test_a_seed_makes_the_same_scene_every_time(name):
    torch.manual_seed(1)
    one = MAKERS[name](3)
    torch.manual_seed(2)
    again, other = MAKERS[name](3), MAKERS[name](4)
    assert torch.equal(one.means, again.means)
    assert torch.equal(one.colors, again.colors)
    assert not torch.equal(one.colors, other.colors)
    assert all(t.dtype == torch.float32 for t in (one.means, one.quats, one.scales, one.opacities, one.colors))


def test_the_hand_is_the_bundled_one():
    drawn, mesh = scenes.hand_scenes(32)
    assert len(drawn.means) == scenes.HAND_GAUSSIANS
    assert len(mesh.faces) == 24_608
    assert len(mesh.vertex_index) + len(mesh.face_index) == len(mesh.quats) == len(drawn.means)


def test_fewer_surfels_cover_as_much():
    def area(scene):
        return float((scene.opacities * scene.scales[:, :2].prod(-1)).sum())

    assert area(scenes.surfels(9_000, 64)) == pytest.approx(area(scenes.hand(64)), rel=0.02)


def test_more_surfels_than_the_hand_has_are_refused():
    with pytest.raises(ValueError, match=r"n: expected 1 to 36881 Gaussians, got 40000"):
        scenes.surfels(40_000, 32)


def test_a_far_camera_sees_the_hand_in_the_same_place():
    (near, _), (far, _) = scenes.hand_scenes(48), scenes.far_hand(48)
    images = [draw(scene.to(dtype=torch.float64)).image for scene in (near, far)]
    assert relative_error(images[1], images[0]) < 0.5
    assert float(far.viewmats[0, 2, 3]) > 99


def test_slivers_are_flat_in_one_direction():
    mesh = scenes.slivers(32)
    variances = torch.linalg.eigvalsh(torch.cov(mesh.posed_vertices.T.double()))
    assert float(variances[0] / variances[-1]) < 1e-5


def test_precision_changes_floats_only():
    mesh = scenes.slivers(32).to(dtype=torch.float64)
    assert mesh.posed_vertices.dtype == torch.float64
    assert mesh.faces.dtype == torch.int64
    assert mesh.name == "slivers"
