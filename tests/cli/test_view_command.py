import http.client
import socket
import threading

import pytest

from oasis_warp.cli import main
from oasis_warp.cli.view import PageServer


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


def test_a_port_that_cannot_be_used_is_refused_in_one_sentence(avatar_file, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        for port in (taken.getsockname()[1], 70000):
            assert main(["view", str(avatar_file), "--port", str(port), "--no-browser"]) == 2
            assert f"--port {port}: " in capsys.readouterr().err
