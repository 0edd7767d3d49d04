import sys

import numpy as np
import pytest
from test_skinned_gltf import surface
from tests.export.splat_readers import READERS

from oasis_warp.core.errors import InputError
from oasis_warp.export import export_avatar
from oasis_warp.export.surface_mesh import topology
from oasis_warp.hand.poses import POSE_NAMES, named_pose

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
        expected = surface(avatar, named_pose(avatar.hand, name))[0]
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
