import numpy as np
import torch
from tests.export.splat_readers import read_gltf

from oasis_warp.export import export_avatar
from oasis_warp.export.material_maps import material_maps
from oasis_warp.export.texture import make_texels

SIZE = 256


def maps_of(avatar, line=None):
    """Maps of grey skin with a dark line, and the middle of the largest square that is all skin."""
    texels = make_texels(avatar.hand, SIZE)
    share = torch.nn.functional.avg_pool2d(texels.inside[None].float(), 31, 1, 15)[0]
    row, column = divmod(int(share.argmax()), SIZE)
    colors = torch.full((SIZE, SIZE, 3), 0.6)
    if line == "along v":
        colors[:, column - 1 : column + 2] = 0.4
    if line == "along u":
        colors[row - 1 : row + 2] = 0.4
    return material_maps(avatar, colors, texels), row, column


def test_skin_leans_towards_a_dark_line(right_hand):
    """As engines read normal maps: red to the right in the picture, green up."""
    maps, row, column = maps_of(right_hand, "along v")
    assert maps[row, column - 2, 0] > 0.55 and maps[row, column + 2, 0] < 0.45
    maps, row, column = maps_of(right_hand, "along u")
    assert maps[row - 2, column, 1] < 0.45 and maps[row + 2, column, 1] > 0.55
    unit = 2 * maps[row, :, :3] - 1
    assert (unit.norm(dim=-1) - 1).abs().max() < 1e-4


def test_skin_of_one_colour_is_smooth_to_the_edges_of_charts(right_hand):
    maps = maps_of(right_hand)[0]
    assert (maps[..., :3] - torch.tensor([0.5, 0.5, 1.0])).abs().max() < 1e-3


def test_nails_shine_more_than_skin(right_hand):
    maps, texels = maps_of(right_hand)[0], make_texels(right_hand.hand, SIZE)
    nail = texels.read(right_hand.hand.nail[:, None], right_hand.hand)[:, 0]
    roughness = maps[..., 3][texels.inside]
    assert roughness[nail > 0.95].max() < 0.4 < 0.5 < roughness[nail < 0.05].min()


def test_materials_name_their_textures_and_unlit_ones_need_none(right_hand, tmp_path):
    for light, names in (("none", ["skin", "normal", "roughness"]), ("baked", ["skin"])):
        export_avatar(right_hand, tmp_path / "hand.glb", light=light)
        document, _ = read_gltf(tmp_path / "hand.glb")
        (material,) = document["materials"]
        looks = material["pbrMetallicRoughness"]
        used = [looks["baseColorTexture"], material.get("normalTexture"), looks.get("metallicRoughnessTexture")]
        images = [document["images"][document["textures"][entry["index"]]["source"]]["name"] for entry in used if entry]
        assert images == names
        assert np.all([entry["mimeType"] == "image/png" for entry in document["images"]])
