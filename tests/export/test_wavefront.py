import cv2
import numpy as np
import pytest
import trimesh

from oasis_warp.core.errors import InputError
from oasis_warp.export import export_avatar
from oasis_warp.export.surface_mesh import topology


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
