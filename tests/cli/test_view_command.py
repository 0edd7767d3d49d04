"""Pages in the browser: `oasis view`, and the form of `oasis serve` with its strangers, wrong files and restarts."""

import base64
import gzip
import http.client
import json
import re
import socket
import struct
import sys
import threading
import time

import cv2
import numpy as np
import pytest
import torch

from oasis_warp.cli import jobs as jobs_module
from oasis_warp.cli import main
from oasis_warp.cli.jobs import MAX_WAITING, RESULTS, Jobs
from oasis_warp.cli.serve import MAX_BYTES, FormServer
from oasis_warp.cli.view import PageServer
from oasis_warp.core.errors import InputError
from oasis_warp.export import export_avatar
from oasis_warp.export.page_data import unpack_data


@pytest.fixture
def server():
    with PageServer("<p>page</p>") as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def ask(server, path, method="GET", host=None):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.request(method, path, headers={"Host": host} if host else {})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def test_the_page_is_served_at_its_address_only(server):
    path = f"/{server.token}/"
    assert server.address == f"http://127.0.0.1:{server.server_port}{path}"
    answer, body = ask(server, path)
    assert (answer.status, body) == (200, b"<p>page</p>")
    assert answer.headers["Cache-Control"] == "no-store"
    assert ask(server, path, "HEAD")[1] == b""
    for wrong in ("/", "/x/", path[:-1], path + "x", path + "../", f"/{server.token[:-1]}./", f"{path}?q"):
        answer, body = ask(server, wrong)
        assert answer.status == 404
        assert b"page" not in body
    assert ask(server, path, "POST")[0].status == 501


def test_a_site_that_points_its_name_here_gets_nothing(server):
    path = f"/{server.token}/"
    assert ask(server, path, host=f"localhost:{server.server_port}")[0].status == 200
    port = server.server_port
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port + 1}"):
        assert ask(server, path, host=host)[0].status == 404


def test_only_this_machine_can_connect_and_tokens_differ(server):
    assert server.server_address[0] == "127.0.0.1"
    with PageServer("x") as other:
        assert len(server.token) >= 24
        assert other.token != server.token


def test_view_serves_the_avatar_until_ctrl_c(avatar_file, monkeypatch, capsys):
    opened, served = [], []

    def serve(self):
        served.append(self.page)
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(PageServer, "serve_forever", serve)
    assert main(["view", str(avatar_file)]) == 0
    assert opened[0] in capsys.readouterr().out
    assert b'<script id="data"' in served[0]
    assert main(["view", str(avatar_file), "--no-browser"]) == 0
    assert len(opened) == 1


def served_by(arguments, monkeypatch):
    served = []

    def serve(self):
        served.append(self.page.decode())
        raise KeyboardInterrupt

    monkeypatch.setattr(PageServer, "serve_forever", serve)
    assert main(["view", *map(str, arguments), "--no-browser"]) == 0
    return served[0]


@pytest.mark.parametrize("ending", [".ply", ".compressed.ply", ".splat", ".spz"])
def test_gaussians_of_other_programs_are_shown_and_cannot_be_posed(scene, tmp_path, monkeypatch, ending):
    avatar, path = scene[2], tmp_path / f"hand{ending}"
    export_avatar(avatar, path)
    page = served_by([path], monkeypatch)
    facts, arrays = unpack_data(re.findall('<script id="data"[^>]*>(.*?)</script>', page)[0])
    assert facts["poses"] == facts["joints"] == []
    means = arrays["means"].reshape(-1, 3)
    assert len(means) == len(avatar.gaussians.scales)
    assert np.abs(means).max() < 0.2  # what is framed has the radius of a hand, wherever it was
    # Photo and file have y down: the fingertips of the upright hand come first, and are the farther from the middle.
    camera, expected = avatar.source_camera, avatar.pose(avatar.source_pose).means
    upright = (expected @ camera.viewmat[:3, :3].T)[:, 1].sort().values
    found = torch.from_numpy(means[:, 1].copy()).sort().values
    assert torch.corrcoef(torch.stack([upright, found]))[0, 1] > 0.9999


def test_a_photo_is_shown_beside_the_hand_upright_and_not_too_large(avatar_file, tmp_path, monkeypatch):
    wide = np.zeros((40, 1200, 3), np.uint8)
    wide[:, :600] = (0, 0, 255)  # red in OpenCV's order
    cv2.imwrite(str(tmp_path / "wide.png"), wide)
    page = served_by([avatar_file, "--photo", tmp_path / "wide.png"], monkeypatch)
    (data,) = re.findall(r'<img id="photo" alt="The photo" src="data:image/jpeg;base64,([^"]*)"', page)
    shown = np.asarray(cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR))
    assert shown.shape == (34, 1024, 3)
    assert shown[17, 100, 2] > 240 > 20 > shown[17, 100, 0]


def test_files_without_gaussians_are_refused_in_one_sentence(tmp_path, capsys):
    ply = b"ply\nformat %s 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    wrong = {
        "cloud.ply": (ply % b"binary_little_endian" + bytes(12), "a point cloud without rot_0"),
        "text.ply": (ply % b"ascii" + b"0 0 0", "binary_little_endian is read, not ascii"),
        "cut.ply": (ply % b"binary_little_endian", "no Gaussians can be read"),
        "huge.ply": (ply.replace(b"vertex 1", b"vertex 99999999999999999999") % b"binary_little_endian", "do not fit"),
        "odd.splat": (bytes(33), "rows of 32 bytes"),
        "empty.splat": (b"", "expected 1 to"),
        "flat.splat": (bytes(32), "got 0 of 1"),
        "new.spz": (gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 5, 0, 0, 12, 0, 0)), "versions 2 to 4"),
        "other.spz": (gzip.compress(bytes(16)), "it is no .spz"),
        "cut.spz": (gzip.compress(bytes(16))[:-12], "no Gaussians can be read"),
    }
    for name, (data, expected) in wrong.items():
        (tmp_path / name).write_bytes(data)
        assert main(["view", str(tmp_path / name), "--no-browser"]) == 2
        error = capsys.readouterr().err
        assert expected in error and name in error and error.count("\n") == 1


def test_a_port_that_cannot_be_used_is_refused_in_one_sentence(avatar_file, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        for port in (taken.getsockname()[1], 70000):
            assert main(["view", str(avatar_file), "--port", str(port), "--no-browser"]) == 2
            assert f"--port {port}: " in capsys.readouterr().err


# In the program's place: "bad" in a photo is refused, "slow" takes its time, and everything else becomes an avatar.
PROGRAM = """
import pathlib, sys, time
_, command, source, _, out, *others = sys.argv
print("landmarks: 0.1 s", file=sys.stderr, flush=True)
data, out = pathlib.Path(source).read_bytes(), pathlib.Path(out)
if b"slow" in data:
    time.sleep(60)
if b"bad" in data:
    sys.exit(f"oasis: {source}: found no hand; give another photo.")
if command == "export":
    assert not others or (others[0] == "--photo" and pathlib.Path(others[1]).read_bytes() == data)
    assert bool(others) == (out.suffix == ".html")
    out.write_bytes(b"page of " + data)
else:
    out.mkdir()
    for name in %s:
        (out / name).write_bytes(data)
"""


@pytest.fixture
def program(tmp_path, monkeypatch):
    script = tmp_path / "program.py"
    script.write_text(PROGRAM % (RESULTS,))
    monkeypatch.setattr(jobs_module, "PROGRAM", (sys.executable, str(script)))


@pytest.fixture
def form_server(program, tmp_path):
    jobs = Jobs(tmp_path / "served")
    with FormServer(jobs) as form_server:
        threads = [
            threading.Thread(target=form_server.serve_forever, kwargs={"poll_interval": 0.01}),
            threading.Thread(target=jobs.work),
        ]
        for thread in threads:
            thread.start()
        yield form_server
        jobs.stop()
        form_server.shutdown()
        for thread in threads:
            thread.join()


def ask_form(form_server, path, method="GET", body=None, token=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", form_server.server_port, timeout=10)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, f"/{token or form_server.token}/{path}", body, named)
    answer = connection.getresponse()
    got = answer.status, answer.read()
    connection.close()
    return got


def send(form_server, photo, name="hand.jpg"):
    status, body = ask_form(form_server, "jobs", "POST", photo, X_Name=name)
    assert status == 201, body
    return json.loads(body)["job"]


def wait(form_server, job, state):
    for _ in range(400):
        found = json.loads(ask_form(form_server, f"jobs/{job}")[1])
        if found["state"] == state:
            return found
        time.sleep(0.02)
    raise AssertionError(found)


def test_a_photo_becomes_an_avatar_whose_files_can_be_had(form_server):
    job = send(form_server, b"photo", "my%20hand.JPG")
    wait(form_server, job, "done")
    assert ask_form(form_server, f"jobs/{job}/avatar.safetensors") == (200, b"photo")
    for _ in range(2):
        assert ask_form(form_server, f"jobs/{job}/hand.html") == (200, b"page of photo")
    for wrong in ("hand.exe", "photo.jpg", "../photo.jpg", "..%2fphoto.jpg", "out/summary.png", ""):
        assert ask_form(form_server, f"jobs/{job}/{wrong}")[0] == (404 if wrong else 200)
    assert ask_form(form_server, f"jobs/{job[:-1]}x")[0] == ask_form(form_server, "jobs/../../x")[0] == 404


def test_a_refused_photo_gets_the_program_s_sentence_and_the_next_one_its_turn(form_server):
    bad, good = send(form_server, b"bad"), send(form_server, b"good")
    assert wait(form_server, bad, "failed")["note"] == "the photo: found no hand; give another photo."
    assert ask_form(form_server, f"jobs/{bad}/summary.png")[0] == 404
    wait(form_server, good, "done")


def no_room(path, data):
    raise InputError(f"{path}: no room left to write it; free some.")


@pytest.mark.parametrize(
    ("broken", "in_its_place", "said"),
    [
        ("write_file", no_room, "the photo: found no hand; give another photo."),
        ("PROGRAM", ("/no/such/program",), "The program failed: [Errno 2] No such file or directory"),
    ],
)
def test_whatever_fails_a_photo_ends_as_failed_and_the_next_ones_get_their_turn(
    program, tmp_path, monkeypatch, broken, in_its_place, said
):
    jobs = Jobs(tmp_path / "served")
    waiting = [jobs.add("a.jpg", b"bad") for _ in range(2)]
    worker = threading.Thread(target=jobs.work, daemon=True)
    with monkeypatch.context() as patch:
        patch.setattr(jobs_module, broken, in_its_place)
        worker.start()
        for job in waiting:
            assert until(jobs, job, "failed").note.startswith(said)
    until(jobs, jobs.add("a.jpg", b"good"), "done")
    jobs.stop()
    worker.join()


def test_strangers_and_other_sites_get_nothing(form_server):
    assert ask_form(form_server, "")[0] == 200
    assert ask_form(form_server, "", token="x" * len(form_server.token))[0] == 404
    for stranger in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
        assert ask_form(form_server, "jobs", "POST", b"photo", X_Name="a.jpg", **stranger)[0] == 404
    assert not list(form_server.jobs.folder.iterdir())
    assert form_server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    ("name", "headers", "status", "output"),
    [
        ("script.py", {}, 422, "script.py: expected a picture, .jpg"),
        ("", {}, 422, "expected a picture"),
        ("a.jpg", {"Content_Length": str(MAX_BYTES + 1)}, 413, "larger than 64 MB"),
        ("a.jpg", {"Content_Length": "9" * 5000}, 413, "larger than 64 MB"),
        ("a.jpg", {"Content_Length": "-1"}, 411, ""),
    ],
)
def test_what_is_no_photo_is_refused(form_server, name, headers, status, output):
    got, body = ask_form(form_server, "jobs", "POST", b"photo", X_Name=name, **headers)
    assert got == status and output in body.decode()
    assert not list(form_server.jobs.folder.iterdir())


def look(jobs, job):
    found = jobs.look(job)
    assert found is not None
    return found


def until(jobs, job, state):
    for _ in range(400):
        if (found := look(jobs, job)).state == state:
            return found
        time.sleep(0.02)
    raise AssertionError(found)


def test_a_browser_that_goes_away_leaves_no_traceback(form_server, capsys):
    for error, words in ((BrokenPipeError(), ""), (TimeoutError(), ""), (ValueError("ours"), "ours")):
        try:
            raise error
        except (OSError, ValueError):
            form_server.handle_error(None, ("127.0.0.1", 1))
        output = capsys.readouterr().err
        assert words in output and bool(output) == bool(words)


def test_a_full_queue_is_said(program, tmp_path):
    jobs = Jobs(tmp_path / "served")
    first = [jobs.add("a.jpg", b"photo") for _ in range(MAX_WAITING)]
    with pytest.raises(InputError, match="16 photos are waiting already"):
        jobs.add("a.jpg", b"photo")
    assert [look(jobs, job).ahead for job in first] == list(range(MAX_WAITING))


def test_a_restart_goes_on_with_what_waited_and_loses_nothing(form_server, tmp_path):
    done = send(form_server, b"photo")
    wait(form_server, done, "done")
    slow = send(form_server, b"slow")
    assert wait(form_server, slow, "running")["note"] in ("starting", "landmarks")
    waiting = send(form_server, b"photo too")
    form_server.jobs.stop()
    (form_server.jobs.folder / waiting / "photo.jpg").write_bytes(b"photo too")
    again = Jobs(tmp_path / "served")
    assert look(again, done).state == "done"
    assert [look(again, job).ahead for job in (slow, waiting)] == [0, 1]


def test_a_photo_that_takes_too_long_is_ended(program, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs_module, "MAX_SECONDS", 0.5)
    jobs = Jobs(tmp_path / "served")
    job = jobs.add("a.jpg", b"slow")
    worker = threading.Thread(target=jobs.work)
    worker.start()
    assert until(jobs, job, "failed").note.startswith("It took longer than")
    jobs.stop()
    worker.join()


def test_the_command_serves_until_ctrl_c_and_refuses_a_file_for_a_folder(tmp_path, monkeypatch, capsys):
    def stop(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(FormServer, "serve_forever", stop)
    assert main(["serve", "--folder", str(tmp_path / "served"), "--no-browser"]) == 0
    assert "The form is at http://127.0.0.1:" in capsys.readouterr().out
    (tmp_path / "file").write_text("")
    assert main(["serve", "--folder", str(tmp_path / "file"), "--no-browser"]) == 2
    assert "file: cannot be made" in capsys.readouterr().err
