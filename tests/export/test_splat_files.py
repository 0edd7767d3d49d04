import math
import struct
import sys

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from tests.export.splat_readers import READERS, read_harmonics

from oasis_warp.core import rotation
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Camera, Gaussians
from oasis_warp.data.splat_files import read_splats
from oasis_warp.export import export_avatar
from oasis_warp.ops import rasterization
from oasis_warp.render import render

LOSSLESS = {".ply", ".splats.glb", ".splats.gltf"}
STEPS = {".spz": 2**-20, ".v4.spz": 2**-20, ".sog": 4e-6, ".compressed.ply": 1e-4}
"""Of means [m]. A chunk of neighbours may span the 0.2 m of a hand, and the coarsest axis has 1023 steps in it;
.sog has 65535 for the hand."""


def redraw(avatar, pose, gaussians):
    """Draw what was read (y up, the wrist at the origin) as the photo's camera sees it, and the avatar itself."""
    camera, wrist = avatar.source_camera, avatar.mesh(pose).joints[0]
    viewmat = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    viewmat[:3, 3] = camera.viewmat[:3, :3] @ wrist + camera.viewmat[:3, 3]
    parts = (torch.from_numpy(np.array(part, np.float32)) for part in gaussians)
    drawn = render(Gaussians(*parts), Camera(viewmat, *camera[1:])).image
    return drawn, render(avatar.pose(pose), camera).image


def psnr(a, b):
    return float(-10 * (a - b).square().mean().log10())


def posed(avatar, name):
    return avatar.held(name)


@pytest.mark.parametrize("ending", READERS)
def test_what_a_file_holds_looks_as_the_avatar_does(left_hand, ending, tmp_path):
    """A wrong axis, sign, order of a quaternion or colour curve shows."""
    pose = posed(left_hand, "victory")
    export_avatar(left_hand, tmp_path / f"hand{ending}", pose=pose)
    drawn, expected = redraw(left_hand, pose, READERS[ending](tmp_path / f"hand{ending}"))
    assert psnr(drawn, expected) > (45 if ending in LOSSLESS else 35)


@pytest.mark.parametrize("ending", READERS)
def test_means_lie_about_the_wrist_within_the_formats_steps(right_hand, ending, tmp_path):
    avatar = right_hand
    export_avatar(avatar, tmp_path / f"hand{ending}")
    means, quats, scales, *_ = READERS[ending](tmp_path / f"hand{ending}")
    pose, turn = avatar.source_pose, torch.diag(torch.tensor([1.0, -1, -1])) @ avatar.source_camera.viewmat[:3, :3]
    expected = ((avatar.pose(pose).means - avatar.mesh(pose).joints[0]) @ turn.T).numpy()
    if ending in LOSSLESS:
        assert np.abs(means - expected).max() <= 1e-6
    else:  # in another order
        for here, there in ((means, expected), (expected, means)):
            assert cKDTree(here).query(there)[0].max() <= STEPS.get(ending, 1e-6)
    assert np.abs(np.linalg.norm(quats, axis=1) - 1).max() < 1e-5
    assert len(scales) == len(avatar.gaussians.scales)


def covariances(quats, scales):
    turns = rotation.to_matrix(torch.as_tensor(np.array(quats, float)))
    parts = turns * torch.as_tensor(np.array(scales, float))[:, None]
    return (parts @ parts.mT).numpy()


@pytest.mark.parametrize("ending", READERS)
def test_gaussians_keep_their_shapes(left_hand, ending, tmp_path):
    """A picture of many hardly shows that quaternions are in the wrong order or frame."""
    avatar = left_hand
    export_avatar(avatar, tmp_path / f"hand{ending}")
    means, quats, scales, *_ = READERS[ending](tmp_path / f"hand{ending}")
    turn = torch.diag(torch.tensor([1.0, -1, -1])) @ avatar.source_camera.viewmat[:3, :3]
    true = avatar.pose(avatar.source_pose)
    expected = covariances(true.quats.numpy(), true.scales.numpy())
    expected = turn.double().numpy() @ expected @ turn.double().numpy().T
    places = ((true.means - avatar.mesh(avatar.source_pose).joints[0]) @ turn.T).numpy()
    away, nearest = cKDTree(places).query(means, 2)
    alone = away[:, 1] > 3 * away[:, 0] + 1e-4  # the others may be taken for a neighbour
    off = covariances(quats, scales) - expected[nearest[:, 0]]
    off = np.linalg.norm(off, axis=(1, 2)) / np.linalg.norm(expected[nearest[:, 0]], axis=(1, 2))
    assert alone.mean() > 0.5
    assert np.quantile(off[alone], 0.99) < (1e-3 if ending in LOSSLESS else 0.1)


def test_without_zstandard_a_sentence_names_the_extra(right_hand, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    words = r"version 4 of .spz needs the package zstandard; install it: pip install 'oasis-warp\[spz\]'"
    with pytest.raises(InputError, match=words):
        export_avatar(right_hand, tmp_path / "hand.v4.spz")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "theirs.spz").write_bytes(struct.pack("<IIIBBBBI", 0x5053474E, 4, 0, 0, 12, 0, 5, 32).ljust(200, b"\0"))
    with pytest.raises(InputError, match=words):
        read_splats(tmp_path / "theirs.spz")


def test_a_stream_of_zstd_gives_no_more_than_its_due(right_hand, tmp_path):
    """A few bytes may stand for gigabytes."""
    zstd = pytest.importorskip("zstandard")
    bomb = zstd.ZstdCompressor().compress(bytes(1 << 26))
    head = struct.pack("<IIIBBBBI", 0x5053474E, 4, 1, 0, 12, 0, 5, 32).ljust(32, b"\0")
    toc = b"".join(struct.pack("<QQ", len(bomb), 1 << 40) for _ in range(5))
    (tmp_path / "bomb.spz").write_bytes(head + toc + 5 * bomb)
    assert len(read_splats(tmp_path / "bomb.spz").means) == 1


def test_a_ply_shows_the_photos_shade_from_the_photos_side_alone(shaded, tmp_path):
    pose = shaded.source_pose
    export_avatar(shaded, tmp_path / "hand.ply")
    coefficients = read_harmonics(tmp_path / "hand.ply")
    splats, vertices = shaded.pose(pose), shaded.mesh(pose).vertices
    shown, source = {}, shaded.source_camera
    for degrees in (8, 60, 180):  # at 0 what is in doubt is as in the photo
        camera = orbit_camera(vertices, math.radians(degrees), size=96)
        drawn, _, _ = rasterization(
            *splats[:4], coefficients, camera.viewmat[None], camera.K[None], 96, 96, sh_degree=3
        )
        shown[degrees] = psnr(drawn[0], shaded.render(camera, pose, (0.0, 0.0, 0.0)).image)
    assert source.viewmat[:3, :3].equal(torch.eye(3)), "the file's axes are those of the world"
    assert shown[8] > 35 and shown[60] > 25 and shown[180] > 35, shown
    plain = render(splats, orbit_camera(vertices, math.pi, size=96)).image
    assert psnr(plain, shaded.render(orbit_camera(vertices, math.pi, size=96), pose, (0.0, 0.0, 0.0)).image) < 25


@pytest.mark.parametrize("ending", [".spz", ".sog"])
def test_equal_avatars_are_equal_bytes(right_hand, ending, tmp_path):
    """A time in the header of a gzip or ZIP would differ."""
    for name in ("a", "b"):
        export_avatar(right_hand, tmp_path / f"{name}{ending}")
    assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"b{ending}").read_bytes()


def test_without_its_light_a_file_holds_the_colours_of_even_light(right_hand, tmp_path):
    colors = {}
    for light in ("baked", "none", None):
        export_avatar(right_hand, tmp_path / "hand.ply", light=light)
        colors[light] = READERS[".ply"](tmp_path / "hand.ply")[-1]
    np.testing.assert_allclose(colors["none"], right_hand.in_even_light().gaussians.colors.numpy(), atol=1e-6)
    assert np.array_equal(colors["baked"], colors[None])
    assert np.abs(colors["baked"] - colors["none"]).max() > 0.1
