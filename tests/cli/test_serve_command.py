"""The form: photos in, avatars out; strangers, wrong files and restarts."""

import http.client
import json
import sys
import threading
import time

import pytest

from oasis_warp.cli import jobs as jobs_module
from oasis_warp.cli import main
from oasis_warp.cli.jobs import MOST_WAITING, RESULTS, Jobs
from oasis_warp.cli.serve import MOST_BYTES, FormServer
from oasis_warp.core.errors import InputError

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
def server(program, tmp_path):
    jobs = Jobs(tmp_path / "served")
    with FormServer(jobs) as server:
        threads = [
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}),
            threading.Thread(target=jobs.work),
        ]
        for thread in threads:
            thread.start()
        yield server
        jobs.stop()
        server.shutdown()
        for thread in threads:
            thread.join()


def ask(server, path, method="GET", body=None, token=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, f"/{token or server.token}/{path}", body, named)
    answer = connection.getresponse()
    got = answer.status, answer.read()
    connection.close()
    return got


def send(server, photo, name="hand.jpg"):
    status, body = ask(server, "jobs", "POST", photo, X_Name=name)
    assert status == 201, body
    return json.loads(body)["job"]


def wait(server, job, state):
    for _ in range(400):
        found = json.loads(ask(server, f"jobs/{job}")[1])
        if found["state"] == state:
            return found
        time.sleep(0.02)
    raise AssertionError(found)


def test_a_photo_becomes_an_avatar_whose_files_can_be_had(server):
    job = send(server, b"photo", "my%20hand.JPG")
    wait(server, job, "done")
    assert ask(server, f"jobs/{job}/avatar.safetensors") == (200, b"photo")
    for _ in range(2):
        assert ask(server, f"jobs/{job}/hand.html") == (200, b"page of photo")
    for wrong in ("hand.exe", "photo.jpg", "../photo.jpg", "..%2fphoto.jpg", "out/summary.png", ""):
        assert ask(server, f"jobs/{job}/{wrong}")[0] == (404 if wrong else 200)
    assert ask(server, f"jobs/{job[:-1]}x")[0] == ask(server, "jobs/../../x")[0] == 404


def test_a_refused_photo_gets_the_program_s_sentence_and_the_next_one_its_turn(server):
    bad, good = send(server, b"bad"), send(server, b"good")
    assert wait(server, bad, "failed")["note"] == "the photo: found no hand; give another photo."
    assert ask(server, f"jobs/{bad}/summary.png")[0] == 404
    wait(server, good, "done")


def test_strangers_and_other_sites_get_nothing(server):
    assert ask(server, "")[0] == 200
    assert ask(server, "", token="x" * len(server.token))[0] == 404
    for stranger in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
        assert ask(server, "jobs", "POST", b"photo", X_Name="a.jpg", **stranger)[0] == 404
    assert not list(server.jobs.folder.iterdir())
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    ("name", "headers", "status", "said"),
    [
        ("script.py", {}, 422, "script.py: expected a picture, .jpg"),
        ("", {}, 422, "expected a picture"),
        ("a.jpg", {"Content_Length": str(MOST_BYTES + 1)}, 413, "more than 64 MB"),
        ("a.jpg", {"Content_Length": "-1"}, 411, ""),
    ],
)
def test_what_is_no_photo_is_refused(server, name, headers, status, said):
    got, body = ask(server, "jobs", "POST", b"photo", X_Name=name, **headers)
    assert got == status and said in body.decode()
    assert not list(server.jobs.folder.iterdir())


def look(jobs, job):
    found = jobs.look(job)
    assert found is not None
    return found


def test_a_full_queue_is_said(program, tmp_path):
    jobs = Jobs(tmp_path / "served")
    first = [jobs.add("a.jpg", b"photo") for _ in range(MOST_WAITING)]
    with pytest.raises(InputError, match="16 photos are waiting already"):
        jobs.add("a.jpg", b"photo")
    assert [look(jobs, job).ahead for job in first] == list(range(MOST_WAITING))


def test_a_restart_goes_on_with_what_waited_and_loses_nothing(server, tmp_path):
    done = send(server, b"photo")
    wait(server, done, "done")
    slow = send(server, b"slow")
    assert wait(server, slow, "running")["note"] in ("starting", "landmarks")
    waiting = send(server, b"photo too")
    server.jobs.stop()
    (server.jobs.folder / waiting / "photo.jpg").write_bytes(b"photo too")
    again = Jobs(tmp_path / "served")
    assert look(again, done).state == "done"
    assert [look(again, job).ahead for job in (slow, waiting)] == [0, 1]


def test_a_photo_that_takes_too_long_is_ended(program, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs_module, "MOST_SECONDS", 0.5)
    jobs = Jobs(tmp_path / "served")
    job = jobs.add("a.jpg", b"slow")
    worker = threading.Thread(target=jobs.work)
    worker.start()
    while look(jobs, job).state != "failed":
        time.sleep(0.02)
    jobs.stop()
    worker.join()
    assert look(jobs, job).note.startswith("It took more than")


def test_the_command_serves_until_ctrl_c_and_refuses_a_file_for_a_folder(tmp_path, monkeypatch, capsys):
    def stop(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(FormServer, "serve_forever", stop)
    assert main(["serve", "--folder", str(tmp_path / "served"), "--no-browser"]) == 0
    assert "Photos are taken at http://127.0.0.1:" in capsys.readouterr().out
    (tmp_path / "file").write_text("")
    assert main(["serve", "--folder", str(tmp_path / "file"), "--no-browser"]) == 2
    assert "file: cannot be made" in capsys.readouterr().err
