"""Files for other programs: what every format keeps, and what these programs read where they are installed."""

import json
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from test_skinned_gltf import surface
from tests.export.splat_readers import READERS

from oasis_warp.cli import main
from oasis_warp.core.errors import InputError
from oasis_warp.data.splat_files import read_splats
from oasis_warp.export import export_avatar
from oasis_warp.export.formats import WRITERS, choose_writer
from oasis_warp.export.surface_mesh import topology
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.hand_avatar import Avatar


@pytest.mark.parametrize("ending", WRITERS)
def test_the_longest_ending_chooses_the_writer_whatever_its_case(ending):
    assert choose_writer(f"some.folder/My.Hand{ending.upper()}") is WRITERS[ending]


@pytest.mark.parametrize("name", ["hand.xyz", "hand", ".ply"])
def test_an_unknown_ending_is_refused_and_the_known_ones_are_named(right_hand, tmp_path, name):
    with pytest.raises(InputError, match=r"expected a name that ends in .*\.ply"):
        export_avatar(right_hand, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_light_is_refused(right_hand, tmp_path, as_shipped):
    with pytest.raises(ValueError, match="light: expected one of 'baked', 'none', got 'moon'"):
        export_avatar(right_hand, tmp_path / "hand.ply", light="moon")


@pytest.mark.parametrize("ending", [".glb", ".ply", ".json", ".obj"])
def test_a_wrong_pose_is_refused_in_every_format(right_hand, ending, tmp_path, as_shipped):
    """Meshes with bones take its angles only, and would write what they give."""
    pose = right_hand.source_pose
    broken = pose.angles.clone()
    broken[3, 0] = torch.nan
    for angles, message in ((torch.zeros(2, 15, 3), r"expected shape \[15, 3\]"), (broken, "angles")):
        with pytest.raises(ValueError, match=message):
            export_avatar(right_hand, tmp_path / f"hand{ending}", pose=pose._replace(angles=angles))
    assert list(tmp_path.iterdir()) == []


def test_a_pose_has_a_name_as_everywhere_and_what_is_none_is_refused(right_hand, tmp_path, as_shipped):
    for name, pose in (("a.json", "fist"), ("b.json", right_hand.held("fist"))):
        export_avatar(right_hand, tmp_path / name, pose=pose)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    with pytest.raises(TypeError, match="pose: expected a HandPose or a pose's name, got int"):
        export_avatar(right_hand, tmp_path / "c.json", pose=3)
    with pytest.raises(TypeError, match="photo: expected a Photo or its file, got int"):
        export_avatar(right_hand, tmp_path / "c.html", photo=3)


@pytest.mark.parametrize("ending", [".glb", ".spz", ".obj", ".json"])
def test_avatars_on_a_device_or_with_gradients_are_the_same_files(left_hand, ending, device, tmp_path):
    left_hand.save(tmp_path / "avatar.safetensors")
    other = Avatar.load(tmp_path / "avatar.safetensors", device)
    colors = other.gaussians.colors.clone().requires_grad_()
    other = other.with_looks(other.gaussians._replace(colors=colors), other.light)
    for name, avatar in (("a", left_hand), ("b", other)):
        (tmp_path / name).mkdir()
        export_avatar(avatar, tmp_path / name / f"hand{ending}")
    assert (tmp_path / f"a/hand{ending}").read_bytes() == (tmp_path / f"b/hand{ending}").read_bytes()


def test_values_that_are_not_finite_never_leave(right_hand, tmp_path):
    """A file from before must stay, and nothing half-written beside it."""
    (tmp_path / "hand.ply").write_bytes(b"before")
    scales = right_hand.gaussians.scales.clone()
    scales[7] = torch.nan
    broken = right_hand.with_looks(right_hand.gaussians._replace(scales=scales), None)
    with pytest.raises(InputError, match="expected finite Gaussians, got 1 that are not"):
        export_avatar(broken, tmp_path / "hand.ply")
    assert (tmp_path / "hand.ply").read_bytes() == b"before"
    assert len(list(tmp_path.iterdir())) == 1


def test_huge_gaussians_are_held_to_the_width_of_a_finger(right_hand, tmp_path, caplog):
    scales = right_hand.gaussians.scales.clone()
    scales[7] = 5.0
    broken = right_hand.with_looks(right_hand.gaussians._replace(scales=scales), None)
    export_avatar(broken, tmp_path / "hand.ply")
    assert READERS[".ply"](tmp_path / "hand.ply")[2].max() <= 0.0200001
    assert "1 of" in caplog.text and "20 mm" in caplog.text


def test_a_page_has_the_photo_beside_the_hand_and_other_formats_refuse_it(left_hand, tmp_path, capsys):
    left_hand.save(tmp_path / "avatar.safetensors")
    cv2.imwrite(str(tmp_path / "photo.png"), np.zeros((40, 36, 3), np.uint8))
    for name, code in (("hand.html", 0), ("hand.ply", 2)):
        given = ["-o", str(tmp_path / name), "--photo", str(tmp_path / "photo.png")]
        assert main(["export", str(tmp_path / "avatar.safetensors"), *given]) == code
    assert "hand.ply: cannot hold --photo" in capsys.readouterr().err
    assert '<img id="photo"' in (tmp_path / "hand.html").read_text()


def test_the_command_writes_a_pose_in_a_light(left_hand, tmp_path):
    left_hand.save(tmp_path / "avatar.safetensors")
    out = tmp_path / "hand.ply"
    assert main(["export", str(tmp_path / "avatar.safetensors"), "-o", str(out)]) == 0
    plain = out.read_bytes()
    arguments = ["--pose", "fist", "--light", "none"]
    assert main(["export", str(tmp_path / "avatar.safetensors"), "-o", str(out), *arguments]) == 0
    assert len(out.read_bytes()) == len(plain) and out.read_bytes() != plain


def test_the_command_names_a_wrong_ending_before_it_reads_the_avatar(tmp_path, capsys):
    assert main(["export", str(tmp_path / "missing.safetensors"), "-o", str(tmp_path / "hand.doc")]) == 2
    assert "expected a name that ends in" in capsys.readouterr().err


def test_rotations_as_manos_place_the_joints(avatar, tmp_path):
    """A forward pass as MANO's: rotations relative to parents, about joints at rest. Catches a transposed one."""
    pose = avatar.source_pose._replace(angles=named_pose(avatar.hand, "ok"))
    export_avatar(avatar, tmp_path / "hand.json", pose=pose)
    read = json.loads((tmp_path / "hand.json").read_text())
    mano, parents = read["as_mano"], avatar.hand.parents
    rest = np.array(mano["rest_joints"])
    turns = [cv2.Rodrigues(np.array(mano["global_orient"]))[0]]
    places = [turns[0] @ rest[0] + mano["transl"]]
    for joint, vector in enumerate(mano["hand_pose"], start=1):
        above = parents[joint]
        places.append(places[above] + turns[above] @ (rest[joint] - rest[above]))
        turns.append(turns[above] @ cv2.Rodrigues(np.array(vector))[0])
    np.testing.assert_allclose(places, avatar.mesh(pose).joints, atol=2e-6)
    np.testing.assert_allclose(read["landmarks"]["index1"], places[1], atol=2e-6)
    np.testing.assert_allclose(read["landmarks"]["thumb4"], avatar.mesh(pose).tips[0], atol=2e-6)


def test_the_file_gives_back_shape_pose_and_camera(left_hand, tmp_path):
    export_avatar(left_hand, tmp_path / "hand.json")
    read = json.loads((tmp_path / "hand.json").read_text())
    assert read["side"] == "left"
    assert list(read["shape"].values()) == left_hand.shape.tolist()
    angles = [list(row.values()) for row in read["pose"]["angles"].values()]
    assert torch.equal(torch.tensor(angles), left_hand.source_pose.angles)
    assert list(read["pose"]["angles"]) == list(left_hand.hand.joint_names[1:])
    assert torch.equal(torch.tensor(read["camera"]["K"]), left_hand.source_camera.K)


def test_trimesh_reads_a_closed_hand_in_the_photos_pose(avatar, tmp_path):
    export_avatar(avatar, tmp_path / "hand.obj")
    read = trimesh.load(tmp_path / "hand.obj", process=False, skip_materials=True)
    posed, mesh = avatar.mesh(avatar.source_pose), topology(avatar)
    axes = np.diag([1, -1, -1]) @ avatar.source_camera.viewmat[:3, :3].numpy()
    expected = (posed.vertices - posed.joints[0]).numpy()[mesh.vertex] @ axes.T
    assert np.abs(read.vertices[:-1] - expected).max() < 1e-6
    assert np.array_equal(read.faces, mesh.faces.numpy())
    welded = trimesh.Trimesh(read.vertices, read.faces, process=False)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    assert welded.is_watertight and welded.volume > 2e-4  # metres; negative if faces wind inwards


def test_the_files_name_each_other(right_hand, tmp_path):
    export_avatar(right_hand, tmp_path / "my hand.obj")
    assert (tmp_path / "my hand.obj").read_text().startswith("mtllib my hand.mtl\n")
    assert "map_Kd my hand_skin.png\n" in (tmp_path / "my hand.mtl").read_text()
    assert np.asarray(cv2.imread(str(tmp_path / "my hand_skin.png"))).shape == (128, 128, 3)
    assert len(list(tmp_path.iterdir())) == 3


def test_no_file_appears_where_one_cannot(right_hand, tmp_path):
    (tmp_path / "hand.mtl").mkdir()
    with pytest.raises(InputError, match=r"hand.mtl: expected a file to write, found a folder"):
        export_avatar(right_hand, tmp_path / "hand.obj")
    assert [file.name for file in tmp_path.iterdir()] == ["hand.mtl"]


ENDINGS = [".usdc", ".usdz", ".splats.usda"]


@pytest.mark.parametrize("ending", ENDINGS)
def test_without_usd_core_a_sentence_names_the_extra(right_hand, ending, tmp_path, monkeypatch):
    for name in ["pxr", *(name for name in sys.modules if name.startswith("pxr."))]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"usd-core; install it: pip install 'oasis-warp\[usd\]'"):
        export_avatar(right_hand, tmp_path / f"hand{ending}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ENDINGS)
def test_usds_own_checks_find_nothing(right_hand, ending, tmp_path):
    validation, usd = pytest.importorskip("pxr.UsdValidation"), pytest.importorskip("pxr.Usd")
    export_avatar(right_hand, tmp_path / f"hand{ending}")
    checks = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    found = checks.Validate(usd.Stage.Open(str(tmp_path / f"hand{ending}")))
    assert [f"{error.GetName()}: {error.GetMessage()}" for error in found] == []


@pytest.mark.slow
def test_usds_own_skinning_gives_our_poses(avatar, tmp_path):
    usd, skel = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdSkel")
    vt = pytest.importorskip("pxr.Vt")
    export_avatar(avatar, tmp_path / "hand.usdc")
    stage = usd.Stage.Open(str(tmp_path / "hand.usdc"))
    cache, mesh = skel.Cache(), stage.GetPrimAtPath("/hand/skin")
    cache.Populate(skel.Root(stage.GetDefaultPrim()), usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(skel.Skeleton(stage.GetPrimAtPath("/hand/skeleton")))
    skinning, shapes = cache.GetSkinningQuery(mesh), skel.BlendShapeQuery(skel.BindingAPI(mesh))
    for k, name in enumerate(POSE_NAMES[1:], start=1):
        time = usd.TimeCode(8 * k)
        points = vt.Vec3fArray(mesh.GetAttribute("points").Get())
        bends = query.GetAnimQuery().ComputeBlendShapeWeights(time)
        weights, indices, subshapes = shapes.ComputeSubShapeWeights(bends)
        offsets = shapes.ComputeBlendShapePointIndices(), shapes.ComputeSubShapePointOffsets()
        assert shapes.ComputeDeformedPoints(weights, indices, subshapes, *offsets, points)
        assert skinning.ComputeSkinnedPoints(query.ComputeSkinningTransforms(time), points, time)
        expected = surface(avatar, avatar.held(name).angles)[0]
        assert np.abs(np.array(points)[:-1] - expected[topology(avatar).vertex]).max() < 5e-6


def test_a_splat_stage_holds_what_a_ply_does(left_hand, tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    export_avatar(left_hand, tmp_path / "hand.splats.usdz")
    export_avatar(left_hand, tmp_path / "hand.ply")
    stage = usd.Stage.Open(str(tmp_path / "hand.splats.usdz"))
    prim = stage.GetPrimAtPath("/hand/splats")
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    means, quats, scales, opacities, colors = READERS[".ply"](tmp_path / "hand.ply")
    get = {name: np.array(prim.GetAttribute(name).Get()) for name in ("positions", "scales", "opacities")}
    np.testing.assert_allclose(get["positions"], means, atol=1e-6)
    np.testing.assert_allclose(get["scales"], scales, rtol=1e-4)
    np.testing.assert_allclose(get["opacities"], opacities, atol=1e-5)
    found = [[q.GetReal(), *q.GetImaginary()] for q in prim.GetAttribute("orientations").Get()[:100]]
    assert np.abs((np.array(found) * quats[:100]).sum(1)).min() > 1 - 1e-5
    harmonics = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * harmonics, colors, atol=1e-5)


FORMATS = {
    ".ply": "ply", ".compressed.ply": "compressed.ply", ".splat": "splat", ".sog": "sog", ".spz": "spz",
    ".v4.spz": "spz",
}  # fmt: skip
"""As gaussforge calls them."""


def by_gaussforge(path, ending, out):
    gaussforge = pytest.importorskip("gaussforge").GaussForge()
    result = gaussforge.convert(path.read_bytes(), FORMATS[ending], "ply")
    assert "error" not in result, result["error"]
    out.write_bytes(result["data"])


def by_splat_transform(path, ending, out):
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("needs `npm install -g @playcanvas/splat-transform`")
    subprocess.run([program, str(path), str(out)], check=True, timeout=200, capture_output=True)


@pytest.mark.slow
@pytest.mark.parametrize("convert", [by_gaussforge, by_splat_transform])
@pytest.mark.parametrize("ending", FORMATS)
def test_other_programs_read_the_same_gaussians(left_hand, tmp_path, ending, convert):
    """A mistake that our writer and our reader share shows."""
    path, out = tmp_path / f"hand{ending}", tmp_path / "again.ply"
    if ending == ".v4.spz":
        pytest.importorskip("zstandard")
    export_avatar(left_hand, path)
    convert(path, ending, out)
    means, _, scales, opacities, colors = READERS[ending](path)
    theirs = READERS[".ply"](out)
    if ending.endswith(".spz"):  # both leave y up in a .ply, where it points down
        means = means * [1, -1, -1]
    away, index = cKDTree(theirs[0]).query(means, 2)
    assert len(theirs[0]) == len(means)
    assert away[:, 0].max() < 1e-5
    alone = away[:, 1] > 3 * away[:, 0] + 1e-4  # the others may be taken for a neighbour
    near = index[alone, 0]
    assert alone.mean() > 0.5
    np.testing.assert_allclose(np.sort(theirs[2][near]), np.sort(scales[alone]), rtol=1e-3)
    np.testing.assert_allclose(theirs[3][near], opacities[alone], atol=4e-3)
    np.testing.assert_allclose(theirs[4][near], colors[alone], atol=4e-3)


@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3, 4])
def test_spz_of_another_program_is_read(right_hand, tmp_path, version):
    gaussforge = pytest.importorskip("gaussforge").GaussForge()
    export_avatar(right_hand, tmp_path / "hand.ply")
    if version == 4:
        pytest.importorskip("zstandard")
    result = gaussforge.convert((tmp_path / "hand.ply").read_bytes(), "ply", "spz", spz_version=version)
    assert "error" not in result, result["error"]
    (tmp_path / "theirs.spz").write_bytes(result["data"])
    found, expected = read_splats(tmp_path / "theirs.spz"), read_splats(tmp_path / "hand.ply")
    away, _ = cKDTree(found.means.numpy() * [1, -1, -1]).query(expected.means.numpy())
    assert away.max() < 5e-4  # its steps are a quarter of a millimetre
