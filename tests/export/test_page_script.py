"""The page's own script, run without a browser, computes what Python does."""

import dataclasses
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch
from synthetic import avatar_of, crop_of
from tests.export.page_parts import LARGEST, section

from oasis_kernels import constants
from oasis_kernels.scene import sky_exposure as kernels
from oasis_warp.avatar import vertex_light
from oasis_warp.avatar.sky import studio_light
from oasis_warp.core.camera import ORBIT_FIELD_OF_VIEW, orbit_camera
from oasis_warp.export.page_data import NO_JOINT, unpack_data
from oasis_warp.export.page_file import page_html, page_text
from oasis_warp.ops import contact
from oasis_warp.reference import posing

NODE = shutil.which("node")


@pytest.mark.parametrize(
    ("file", "name", "value"),
    [
        ("shading.js", "GAMMA", vertex_light.GAMMA),
        ("shading.js", "HALF_HAND", vertex_light.HALF_HAND),
        ("shading.js", "NEAREST", vertex_light.NEAREST),
        ("shading.js", "SAME_POSE", vertex_light.SAME_POSE),
        ("shading.js", "OTHER_POSE", vertex_light.OTHER_POSE),
        ("shading.js", "SAME_SKY", vertex_light.SAME_SKY),
        ("shading.js", "OTHER_SKY", vertex_light.OTHER_SKY),
        ("shading.js", "SAME_BESIDE", vertex_light.SAME_BESIDE),
        ("shading.js", "OTHER_BESIDE", vertex_light.OTHER_BESIDE),
        ("shading.js", "NO_JOINT", NO_JOINT),
        ("shading.js", "WEAK", vertex_light.WEAK),
        ("shading.js", "DEEP", vertex_light.DEEP),
        ("sky.js", "BUFFER", kernels.SIZE),
        ("sky.js", "MARGIN", kernels.MARGIN),
        ("sky.js", "LIFT", kernels.LIFT),
        ("contact.js", "DEEPEST", contact.DEEPEST),
        ("contact.js", "ASIDE", contact.ASIDE),
        ("contact.js", "PUSH", contact.MARGIN),
        ("contact.js", "PAD", contact.PAD),
        ("contact.js", "OPPOSED", contact.OPPOSED),
        ("contact.js", "PARTS_OPPOSED", contact.PARTS_OPPOSED),
        ("contact.js", "FADES", contact.FADES),
        ("contact.js", "ROUNDS", contact.kernels.ROUNDS),
        ("posing.js", "FLAT", posing.FLAT),
        ("posing.js", "DAMPING", posing.DAMPING),
        ("posing.js", "MAX_GROWTH", posing.LIMIT),
        ("projection.js", "EPS2D", constants.EPS2D),
        ("projection.js", "JACOBIAN_LIMIT", constants.JACOBIAN_LIMIT),
        ("raster.js", "EXACT = { opaque: 1 / 100, reach:", constants.EXTENT_SIGMAS),
    ],
)
def test_the_script_has_the_constants_of_the_operators(file, name, value):
    sign = "" if name.endswith(":") else " ="
    (found,) = re.findall(rf"\b{re.escape(name)}{sign} ([\d.e-]+)", page_text(file))
    assert float(found) == pytest.approx(value, rel=1e-12)


NODE_CHECK = """
const fs = require("fs"), read = (path) => fs.readFileSync(path, "utf8");
const [folder, jobs] = [process.argv[1], JSON.parse(process.argv[2])];
const run = new Function(read(folder + "/worker.js") + "; return { openHand, drawHand };")();
run.openHand(read(folder + "/data.txt")).then((hand) => {
  for (const [k, job] of jobs.entries()) {
    const { facts, ...wish } = { ...job, camera: { ...job.camera, target: null } };
    wish.angles = hand.body.data.poses.find(({ name }) => name === job.pose).angles;
    run.drawHand(hand, wish);
    const bytes = (array) => Buffer.from(array.buffer, array.byteOffset, array.byteLength);
    fs.writeFileSync(`${folder}/means${k}`, bytes(hand.gaussians.means));
    fs.writeFileSync(`${folder}/covars${k}`, bytes(hand.gaussians.covariances));
    fs.writeFileSync(`${folder}/colors${k}`, bytes(hand.shading.colors));
  }
});
"""


def run_script(page, jobs, folder):
    """Pose and light the page's hand with its own script; means, covariances and colours as files of `folder`."""
    for name, file in (("worker", "worker.js"), ("data", "data.txt")):
        (folder / file).write_text(section(page, name))
    camera = {"azimuth": 0, "elevation": 0, "zoom": 1, "fieldOfView": ORBIT_FIELD_OF_VIEW, "width": 64, "height": 64}
    jobs = [job | {"camera": camera | {"azimuth": job.get("azimuth", 0)}} for job in jobs]
    subprocess.run([NODE, "-e", NODE_CHECK, str(folder), json.dumps(jobs)], check=True, timeout=200)


@pytest.mark.slow
@pytest.mark.skipif(NODE is None, reason="needs node")
def test_the_pages_script_poses_a_hand_of_mano_with_all_of_its_correctives(mano, tmp_path):
    crop, truth, pose = crop_of(mano, torch.full((len(mano.template), 3), 0.5), size=64)
    avatar = avatar_of(mano, truth, pose, crop.camera)
    page = page_html(avatar, "MANO")
    assert len(page) <= LARGEST  # 16 bits a corrective made it 15 MB
    run_script(page, [{"pose": "fist", "look": "photo"}], tmp_path)
    _, arrays = unpack_data(section(page, "data"))
    basis = arrays["correctives"].reshape(-1, len(mano.template), 3) * arrays["reach"][:, None, None]
    rounded = dataclasses.replace(mano, corrective_basis=torch.from_numpy(basis).permute(1, 2, 0).to(mano.template))
    expected = avatar_of(rounded, truth, pose, crop.camera)  # rounding moves vertices by some .1 mm
    means = np.fromfile(tmp_path / "means0", "<f4").reshape(-1, 3)
    apart = np.abs(means - expected.pose(avatar.held("fist")).means.numpy())
    assert np.quantile(apart, 0.999) < 3e-5 and apart.max() < 3e-4  # contact of a fist decides by rounded distances


@pytest.mark.slow
@pytest.mark.skipif(NODE is None, reason="needs node")
def test_the_pages_script_poses_and_lights_as_python_does(avatar, pages, tmp_path):
    lights = {"photo": avatar, "studio": avatar.in_light(studio_light()), "even": avatar.in_even_light()}
    jobs = [{"pose": pose, "look": look} for pose in ("fist", "victory") for look in lights]
    run_script(pages[avatar.side], jobs, tmp_path)
    for k, job in enumerate(jobs):
        expected = lights[job["look"]].pose(avatar.held(job["pose"]))
        means = np.fromfile(tmp_path / f"means{k}", "<f4").reshape(-1, 3)
        off = np.abs(means - expected.means.numpy()).max(1)
        assert np.quantile(off, 0.999) < 3e-5 and off.max() < 3e-4  # contact of a fist decides by rounded distances
        variances = np.fromfile(tmp_path / f"covars{k}", "<f4").reshape(-1, 6)[:, [0, 3, 5]].sum(1)
        growth = variances / expected.scales.square().sum(1).numpy()
        assert np.quantile(np.abs(growth - 1), 0.99) < 0.02  # 16 bits move the corners of small faces
        bytes_ = np.fromfile(tmp_path / f"colors{k}", np.uint8).reshape(-1, 4)
        error = np.abs(bytes_[:, :3] - 255 * expected.colors.numpy())
        assert np.quantile(error, 0.98) < 2.5, job  # a pixel of a depth buffer decides about vertices within 10 mm
        assert error.mean() < 0.5, job


@pytest.mark.slow
@pytest.mark.skipif(NODE is None, reason="needs node")
def test_the_pages_script_fades_shade_as_python_does_when_the_camera_leaves(shaded, tmp_path):
    jobs = [{"pose": "photo", "look": "photo", "azimuth": angle} for angle in (0.0, 0.35, -0.5, 1.0, 0.35, 0.08)]
    run_script(page_html(shaded, "A hand"), jobs, tmp_path)
    colors = []
    for k, job in enumerate(jobs):
        camera = orbit_camera(shaded.mesh(shaded.source_pose).vertices, job["azimuth"], 0.0, 64)
        expected = 255 * shaded.pose(shaded.source_pose, camera=camera).colors.numpy()
        colors.append(np.fromfile(tmp_path / f"colors{k}", np.uint8).reshape(-1, 4)[:, :3])
        assert np.abs(colors[k] - expected).max() < 2, job
    assert np.abs(colors[3].astype(float) - colors[0]).mean() > 5 and (colors[4] == colors[1]).all()
