import base64
import gzip
import http.client
import re
import socket
import struct
import threading

import cv2
import numpy as np
import pytest
import torch

from oasis_warp.cli import main
from oasis_warp.cli.view import PageServer
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
    for wrong in ("/", "/x/", path[:-1], path + "x", path + "../", f"/{server.token[:-1]}x/", f"{path}?q"):
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
        "odd.splat": (bytes(33), "rows of 32 bytes"),
        "empty.splat": (b"", "expected 1 to"),
        "flat.splat": (bytes(32), "got 0 of 1"),
        "new.spz": (gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 4, 0, 0, 12, 0, 0)), "versions 2 and 3"),
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
