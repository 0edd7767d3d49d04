"""The page's own script, run without a browser, computes what Python does."""

import dataclasses
import inspect
import json
import math
import re
import shutil
import subprocess
import types

import numpy as np
import pytest
import torch
from synthetic import avatar_of, crop_of
from tests.export.page_parts import LARGEST, section

from oasis_kernels import constants
from oasis_kernels.scene import sky_exposure as kernels
from oasis_warp.avatar import creases, folds, sky, vertex_light, wrinkles
from oasis_warp.avatar.sky import studio_light
from oasis_warp.core.camera import ORBIT_FIELD_OF_VIEW, orbit_camera
from oasis_warp.export import page_data
from oasis_warp.export.page_data import unpack_data
from oasis_warp.export.page_file import page_html, page_text
from oasis_warp.hand import contact as hand_contact
from oasis_warp.ops import contact, rasterization
from oasis_warp.reference import posing

NODE = shutil.which("node")
JS_MATH = types.SimpleNamespace(PI=math.pi, cos=math.cos)
"""What the script's constants, whose formulas are Python as well, use of its `Math`."""


def vars_of(module, names):
    """Constants of a module by name."""
    return {name: getattr(module, name) for name in names.split()}


RULES = {
    "shading.js": {
        **vars_of(vertex_light, "GAMMA AS_IN_PHOTO TURNED_AWAY SAME_POSE OTHER_POSE SAME_VIEW OTHER_VIEW NEAREST"),
        **vars_of(vertex_light, "HALF_HAND SAME_PARALLAX OTHER_PARALLAX SAME_SKY OTHER_SKY SAME_BESIDE OTHER_BESIDE"),
        **vars_of(vertex_light, "WEAK DEEP"),
        **vars_of(sky, "IN_HOLLOWS LEAST_LIGHT IN_CREVICES DEEP_INSIDE OUTSIDE"),
        **vars_of(folds, "CLOSED OPENED"),
        **vars_of(creases, "STRETCHED LEAST_AREA LITTLE COMPRESSED"), "UNSTRETCHED": creases.AS_IN_PHOTO,
        "WRINKLE_HUE": wrinkles.HUE,
        **vars_of(page_data, "NO_JOINT STRETCH"),
    },
    "sky.js": {
        **vars_of(kernels, "MARGIN LIFT STEEPEST"), "BUFFER": kernels.SIZE, "MIN_LIGHT": kernels.LEAST,
        "NEARBY": sky.NEARBY, "LOBE": [sky.LOBE[degree] for degree in sky.DEGREES],
    },
    "contact.js": {
        **vars_of(contact, "DEEPEST ASIDE PAD OPPOSED PARTS_OPPOSED FADES BETWEEN"), "PUSH": contact.MARGIN,
        "ROUNDS": contact.kernels.ROUNDS, **vars_of(hand_contact, "CREVICE FREE"),
    },
    "posing.js": {**vars_of(posing, "FLAT DAMPING"), "MAX_GROWTH": posing.LIMIT},
    "projection.js": {
        **vars_of(constants, "EPS2D JACOBIAN_LIMIT"),
        "NEAR": inspect.signature(rasterization).parameters["near_plane"].default,
    },
}  # fmt: skip
"""Values in Python of the constants of the script's files."""
OWN = {
    "shading.js": {"MAP_SEEN", "MAP_INVENTED", "MAP_SKIN"}, "sky.js": {"HURRY"}, "contact.js": {"BOX"},
    "posing.js": set(), "projection.js": {"FACES_AWAY", "STRIDE", "DEPTHS"},
}  # fmt: skip
"""Constants that only the script has."""


@pytest.mark.parametrize("file", RULES)
def test_the_script_has_the_constants_of_python(file):
    found = {}
    for line in re.findall(r"^const ([A-Z].*?);", page_text(file), re.MULTILINE):
        found |= dict(each.split(" = ") for each in re.split(r", (?=[A-Z_\d]+ = )", line))
    assert found.keys() - OWN[file] == RULES[file].keys()
    for name, value in RULES[file].items():
        assert eval(found[name], {"Math": JS_MATH}) == pytest.approx(value, rel=1e-12), name


def test_the_script_draws_gaussians_as_far_out_as_the_operator():
    (found,) = re.findall(r"EXACT = {.* reach: ([\d.]+)", page_text("raster.js"))
    assert float(found) == constants.EXTENT_SIGMAS


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
