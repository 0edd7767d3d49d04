"""The page in one file: what it holds, and what browsers draw of it."""

import base64
import contextlib
import hashlib
import html
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest
import torch
from tests.export.page_parts import LARGEST, section

from oasis_warp.avatar.sky import studio_light
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.errors import InputError
from oasis_warp.data.splat_files import read_splats
from oasis_warp.export import export_avatar
from oasis_warp.export.page_data import joint_sliders, pack_data, page_facts, unpack_data
from oasis_warp.export.page_file import page_html, splats_html
from oasis_warp.hand import skinning as hand_skinning
from oasis_warp.hand.poses import POSE_NAMES, named_pose
from oasis_warp.ops import bone_transforms, skin
from oasis_warp.render import render

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
FIREFOX = shutil.which("xvfb-run") and (shutil.which("firefox-esr") or shutil.which("firefox"))
"""Without a display it has no WebGL."""
with_chromium, with_firefox = (
    pytest.param(name, marks=pytest.mark.skipif(path is None, reason=f"needs {name}, firefox also xvfb"))
    for name, path in (("chromium", CHROMIUM), ("firefox", FIREFOX))
)


def test_the_page_is_one_file_that_fetches_nothing(pages):
    page = pages["right"]
    assert len(page.encode()) <= LARGEST
    assert "{{" not in page
    assert "<title>A &lt;hand&gt;</title>" in page
    code = page.replace(section(page, "data"), "")
    assert not re.findall(r"https?://|\bfetch\(|XMLHttpRequest|WebSocket|import\(|eval\(", code)
    assert not re.findall(r"<(?:link|img|iframe|object|embed)\b|\bsrc=|\bstyle=|\son\w+=\"", code)


def test_its_policy_allows_only_its_own_style_and_script(pages):
    page = pages["right"]
    (escaped,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)
    policy = html.unescape(escaped)
    assert policy.startswith("default-src 'none';")
    for tag in ("style", "script"):
        (text,) = re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}';" in policy
    assert "unsafe" not in policy


def test_every_control_has_a_label(pages):
    page = pages["right"]
    for identity in re.findall(r'<(?:select|canvas)[^>]*id="(\w+)"', page):
        assert re.search(f'id="{identity}"[^>]*aria-label="', page), identity
    for slider in re.findall(r"<input[^>]*>", page):
        assert re.search(f"<label[^>]*><span>[^<]+</span>{re.escape(slider)}", page), slider
    for identity in re.findall(r'aria-(?:labelledby|controls|describedby)="(\w[\w-]*)"', page):
        assert f'id="{identity}"' in page
    assert "prefers-reduced-motion" in page


@pytest.mark.parametrize("name", ["fist", "point", "open"])
def test_what_the_page_reads_poses_the_same_surface(avatar, pages, name):
    facts, arrays = unpack_data(section(pages[avatar.side], "data"))
    part = {key: torch.from_numpy(np.array(value, np.float32)) for key, value in arrays.items()}
    vertices = part["vertices"].view(-1, 3)
    (angles,) = [known["angles"] for known in facts["poses"] if known["name"] == name]
    bones = bone_transforms(
        torch.tensor(angles).view(15, 3), torch.tensor(facts["orientation"]).view(3, 3),
        torch.tensor(facts["translation"]), part["joints"].view(16, 3), part["axes"].view(16, 3, 3), facts["parents"],
    )  # fmt: skip
    correctives = part["correctives"].view(-1, *vertices.shape).permute(1, 2, 0) * part["reach"]
    posed = skin(
        vertices,
        None,
        part["weights"].view(-1, 16),
        bones.transforms,
        displacements=correctives.contiguous(),
        strengths=bones.bends,
    )
    expected = hand_skinning.skin(*avatar.parts[:2], avatar.held(name)).vertices  # nothing gives way there
    assert (posed.means - expected).abs().max() < 2e-5  # 16 bit for weights and correctives


def test_what_the_page_reads_are_the_gaussians(avatar, pages):
    facts, arrays = unpack_data(section(pages[avatar.side], "data"))
    stored = avatar.parts.gaussians
    assert np.array_equal(arrays["vertexIndex"], stored.vertex_index)
    assert np.array_equal(arrays["faceIndex"], stored.face_index)
    for name, step in {"scales": 1e-4 * float(stored.scales.max()), "opacities": 2e-3, "colors": 2e-3}.items():
        assert np.abs(arrays[name] - getattr(stored, name).flatten().numpy()).max() <= step, name
    assert facts["side"] == avatar.side
    assert facts["lights"].keys() == {"photo", "studio"}


def test_the_page_keeps_how_black_specks_fade(right_hand):
    """A byte that ended at a logarithm of 1 made a mole on a palm darker instead of paler as the skin is stretched."""
    gaussians = right_hand.gaussians
    creases = right_hand.in_light(studio_light()).parts.creases
    colors = gaussians.colors.index_fill(0, creases.index[::500], 0.01)
    specked = right_hand.with_looks(gaussians._replace(colors=colors), right_hand.light)
    parts = specked.in_light(studio_light()).parts
    expected = torch.zeros_like(colors).index_copy(0, parts.folds.index, parts.folds.change)
    expected = expected.index_copy(0, parts.creases.index, parts.creases.change)
    most = float(expected.abs().max())
    assert most > 2
    _, arrays = unpack_data(section(page_html(specked, "x"), "data"))
    assert np.abs(arrays["folds"] - expected.flatten().numpy()).max() < 0.51 * most / 127  # half a step


def test_values_that_their_bytes_cannot_hold_are_refused(right_hand):
    gaussians = right_hand.gaussians
    for opacity in (1.2, -0.1, float("nan")):
        wrong = gaussians._replace(opacities=gaussians.opacities.index_fill(0, torch.tensor([3]), opacity))
        with pytest.raises(InputError, match=rf"expected values from 0 to 1, got .*{opacity}.*; reconstruct"):
            page_html(right_hand.with_looks(wrong, right_hand.light), "x")


def test_sliders_move_what_they_say_within_the_limits(hand):
    groups = joint_sliders(hand)
    assert [group["finger"] for group in groups] == ["Thumb", "Index", "Middle", "Ring", "Little"]
    sliders = [slider for group in groups for slider in group["joints"]]
    assert len({slider["index"] for slider in sliders}) == len(sliders)
    for group in groups:
        for slider in group["joints"]:
            joint, axis = divmod(slider["index"], 3)
            assert hand.joint_names[joint + 1].startswith(group["finger"].lower())
            assert hand.pose_limits[joint + 1, axis].tolist() == [slider["low"], slider["high"]]
    assert [len(group["joints"]) for group in groups] == [7, 5, 5, 5, 5]


def test_the_page_begins_with_the_pose_and_light_that_were_asked_for(right_hand, tmp_path):
    out = tmp_path / "hand.html"
    export_avatar(right_hand, out, pose=right_hand.held("fist"), light="none")
    start = unpack_data(section(out.read_text(), "data"))[0]["start"]
    assert (start["pose"], start["look"]) == ("fist", "even")
    assert np.allclose(start["angles"], named_pose(right_hand.hand, "fist").flatten(), atol=1e-6)


def test_an_avatar_without_light_of_its_own_begins_in_even_light(right_hand):
    facts, arrays = unpack_data(section(page_html(right_hand.in_even_light(), "x"), "data"))
    assert facts["start"]["look"] == "even"
    assert facts["lights"].keys() == {"studio"}
    assert (arrays["even"] == 1).all()


REPORT = """
<script>oasis.ready.then(async () => {
  for (const [k, job] of JOBS.entries()) await fetch("/" + k, { method: "POST", body: await oasis.picture(job) });
}, (error) => fetch("/failed", { method: "POST", body: String(error) }))</script>
"""
"""What the test adds to a page, so that it sends its pictures back."""
FLAGS = (
    "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync --use-angle=swiftshader --enable-unsafe-swiftshader --window-size=852,750"
)


class PictureServer(ThreadingHTTPServer):
    """Serves a page and keeps what it sends."""

    def __init__(self, page):
        self.page, self.received = page.encode(), queue.Queue()
        super().__init__(("127.0.0.1", 0), PictureHandler)


class PictureHandler(BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.end_headers()
        self.wfile.write(self.server.page)

    def do_POST(self):
        self.server.received.put((self.path, self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(204)
        self.end_headers()

    def log_message(self, format, *args):
        pass


@contextlib.contextmanager
def browser_with(page, drawing, profile, browser="chromium"):
    """What a headless browser sends back from the page."""
    with PictureServer(page) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/#{drawing}"
        profile.mkdir()
        command = {
            "chromium": [CHROMIUM, *FLAGS.split(), f"--user-data-dir={profile}", "--remote-debugging-port=0", address],
            "firefox": ["xvfb-run", "-a", FIREFOX, "--no-remote", "--profile", str(profile), address],
        }[browser]
        (profile / "user.js").write_text('user_pref("webgl.force-enabled", true);')  # Firefox, on llvmpipe
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(command, start_new_session=True, **silent)
        try:
            yield server.received
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            server.shutdown()


def pictures_of(page, drawing, jobs, profile, browser="chromium"):
    """What a browser draws of each job, over white."""
    page = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    page = page.replace("</body>", REPORT.replace("JOBS", json.dumps(jobs)) + "</body>")
    with browser_with(page, drawing, profile, browser) as received:
        for k in range(len(jobs)):
            path, body = received.get(timeout=100)
            assert path == f"/{k}", body
            picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
            shown = np.asarray(picture)[..., [2, 1, 0, 3]] / 255
            yield shown[..., :3] * shown[..., 3:] + 1 - shown[..., 3:]


@pytest.mark.slow
@pytest.mark.parametrize("browser", [with_chromium, with_firefox])
@pytest.mark.parametrize("drawing", ["graphics", "processor"])
def test_a_browser_draws_the_page_as_we_do(left_hand, right_hand, pages, tmp_path, drawing, browser):
    """Each side in each browser and each way to draw, in four of the eight combinations."""
    avatar = right_hand if (drawing == "graphics") == (browser == "chromium") else left_hand
    photo, even, studio = "photo", "even", "studio"
    views = [
        ("photo", 0, photo),
        ("fist", 30, photo),
        ("victory", -45, studio),
        ("point", 180, photo),
        ("ok", 90, even),
    ]
    square = {"elevation": 0, "width": 256, "height": 256, "fit": True}
    jobs = [{"pose": pose, "azimuth": np.radians(angle), "look": look, **square} for pose, angle, look in views]
    lights = {"photo": avatar, "studio": avatar.in_light(studio_light()), "even": avatar.in_even_light()}
    pictures = pictures_of(pages[avatar.side], drawing, jobs, tmp_path / "profile", browser)
    for shown, (name, degrees, look) in zip(pictures, views, strict=True):
        pose = avatar.source_pose if name == "photo" else avatar.held(name)
        camera = orbit_camera(avatar.mesh(pose).vertices, np.radians(degrees), 0.0, 256)
        drawn = lights[look].render(camera, pose).image.clamp(0, 1).numpy()
        assert -10 * np.log10(np.mean((shown - drawn) ** 2)) > 40, (name, look)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
@pytest.mark.parametrize("drawing", ["graphics", "processor"])
def test_a_browser_draws_gaussians_of_other_programs_as_we_do(right_hand, tmp_path, drawing):
    export_avatar(right_hand, tmp_path / "hand.ply")
    read = read_splats(tmp_path / "hand.ply")
    page = splats_html(read, "hand")
    facts, arrays = unpack_data(section(page, "data"))
    reach, means = facts["frame"]["radius"], torch.from_numpy(arrays["means"].reshape(-1, 3).copy())
    scale = means.std() / read.means.std()
    posed = read._replace(means=means, scales=read.scales * scale)
    jobs = [{"azimuth": angle, "elevation": 0, "width": 256, "height": 256, "fit": True} for angle in (0.0, 2.0)]
    for shown, job in zip(pictures_of(page, drawing, jobs, tmp_path / "profile"), jobs, strict=True):
        camera = orbit_camera(torch.tensor([[reach, 0, 0], [-reach, 0, 0]]), job["azimuth"], 0.0, 256)
        drawn = render(posed, camera, background=(1.0, 1.0, 1.0)).image.clamp(0, 1).numpy()
        assert -10 * np.log10(np.mean((shown - drawn) ** 2)) > 40, job


COUNT = """
<script>oasis.ready.then(async (viewer) => {
  const draw = viewer.draw, wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  let count = 0;
  viewer.draw = (...given) => draw(...given).finally(() => count++);
  const busy = () => {
    const values = new Float32Array(50000), end = performance.now() + 2000;
    let rounds = 0;
    for (; performance.now() < end; rounds++) {
      for (let k = 1; k < values.length; k++) values[k] = 0.5 * values[k - 1] + Math.sqrt(k);
    }
    postMessage(rounds);
  };
  const code = URL.createObjectURL(new Blob([`(${busy})()`]));
  const rounds = () => new Promise((resolve) => new Worker(code).onmessage = ({ data }) => resolve(data / 2));
  const speed = async () => (await Promise.all([rounds(), rounds()])).reduce((a, b) => a + b) / 2;
  const first = await speed();
  byId("play").click();
  await wait(3000); // the resolution follows
  const start = performance.now(), before = count;
  await wait(5000);
  const rate = (1000 * (count - before)) / (performance.now() - start);
  byId("play").click();
  await wait(1000);
  const body = [rate, (first + await speed()) / 2, viewer.canvas.clientWidth, viewer.canvas.clientHeight].join(" ");
  fetch("/rate", { method: "POST", body });
}, (error) => fetch("/failed", { method: "POST", body: String(error) }))</script>
"""
QUIET_SHARE = 0.0072
"""Pictures of a moving hand over rounds of the loop `busy` that two threads do at once, each, in the same time."""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_a_moving_hand_is_fluent_without_a_graphics_card(pages, tmp_path):
    """A picture takes at most twice the work that it took when this was written, whatever else the machine does."""
    page = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", pages["right"])
    with browser_with(page.replace("</body>", COUNT + "</body>"), "processor", tmp_path / "profile") as received:
        path, body = received.get(timeout=100)
    assert path == "/rate", body
    rate, speed, width, height = map(float, body.split())
    assert min(width, height) >= 500
    print(f"{rate:.1f} pictures a second of {width:.0f} x {height:.0f}, {speed:.0f} rounds a second")
    assert rate / speed > QUIET_SHARE / 2, (rate, speed)


FAILING = """
<script>oasis.ready.then(async (viewer) => {
  const said = [], wrong = [{ look: "map" }, { look: "map" }, { width: 1e6, height: 1e6 }]; // no map, and no memory
  for (const job of wrong) await oasis.picture(job).catch((error) => said.push(error.message));
  for (viewer.look = "map"; said.length < 6; said.push(byId("status").textContent)) {
    show(viewer);
    await new Promise((resolve) => setTimeout(resolve, 500));
  }
  viewer.look = "even";
  const draw = viewer.draw, drawn = new Promise((resolve) => viewer.draw = (...given) => draw(...given).then(resolve));
  show(viewer);
  await drawn;
  said.push((await oasis.picture({ width: 64, height: 64 })).type);
  fetch("/drawn", { method: "POST", body: JSON.stringify(said) });
}, (error) => {
  fetch("/failed", { method: "POST", body: JSON.stringify([error.message, byId("status").textContent]) });
})</script>
"""
NOT_DRAWN = r"A picture could not be drawn \([^\n]+\); choose another, or load the page again\."


def said_by(page, profile):
    """What a page sends whose pictures fail."""
    page = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page).replace("</body>", FAILING + "</body>")
    with browser_with(page, "processor", profile) as received:
        path, body = received.get(timeout=100)
    return path, json.loads(body)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_a_page_whose_picture_failed_says_why_and_draws_the_next(pages, tmp_path):
    """After two failures it drew nothing more, and scripts waited for their pictures for ever."""
    path, (*said, kind) = said_by(pages["right"], tmp_path / "profile")
    assert (path, len(said), kind) == ("/drawn", 6, "image/png")
    for sentence in said:
        assert re.fullmatch(NOT_DRAWN, sentence)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
@pytest.mark.parametrize("fault", ["data", "picture"])
def test_a_page_that_cannot_begin_says_why(right_hand, pages, tmp_path, fault):
    facts, arrays = page_facts(right_hand, None, "photo")
    facts["start"]["look"] = "map"
    data, message = {
        "data": ("no data", r"The hand could not be opened \([^\n]+\); export it again\."),
        "picture": (pack_data(facts, arrays), NOT_DRAWN),
    }[fault]
    page = pages["right"].replace(section(pages["right"], "data"), data)
    path, said = said_by(page, tmp_path / "profile")
    assert path == "/failed"
    for sentence in said:
        assert re.fullmatch(message, sentence)


def test_all_named_poses_are_on_the_page(pages):
    facts, _ = unpack_data(section(pages["left"], "data"))
    assert [pose["name"] for pose in facts["poses"]] == ["photo", *POSE_NAMES]
