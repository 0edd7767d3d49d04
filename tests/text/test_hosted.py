"""A hosted model: by a client of our own, and where huggingface_hub is installed by that, against a server here."""

import base64
import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import cv2
import numpy as np
import pytest

from oasis_warp.core.errors import InputError
from oasis_warp.text.generators import choose_generator

GREEN = np.full((8, 8, 3), (0, 200, 0), np.uint8)


@pytest.fixture
def folder(tmp_path):
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((16, 16), 77, np.uint8))
    return tmp_path


class FakeClient:
    """Keeps what it is asked."""

    asked: ClassVar[list] = []

    def __init__(self, *, model, token, timeout):
        self.model = model

    def image_to_image(self, image, *, prompt, seed):
        self.asked.append((self.model, image, prompt, seed))
        if "fail" in prompt:
            raise ValueError("no provider has this model")
        return SimpleNamespace(convert=lambda mode: GREEN)


@pytest.fixture
def fake_hub(monkeypatch):
    hub = ModuleType("huggingface_hub")
    hub.InferenceClient, hub.get_token = FakeClient, lambda: "hf_x"
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    monkeypatch.setattr(FakeClient, "asked", [])
    return hub


def test_depth_words_and_seed_go_to_the_model_that_is_named(fake_hub, folder):
    photo = choose_generator("hosted:some/model")(folder, "a pale hand", 7)
    ((model, image, prompt, seed),) = FakeClient.asked
    assert (model, image, seed) == ("some/model", (folder / "depth.png").read_bytes(), 7)
    assert prompt.startswith("a pale hand") and "depth" in prompt
    assert np.array_equal(photo.rgb.numpy(), GREEN)


def test_nothing_is_asked_before_there_is_a_picture_to_follow(fake_hub):
    choose_generator("hosted")
    assert FakeClient.asked == []


def test_what_the_service_says_is_one_sentence(fake_hub, folder):
    with pytest.raises(InputError, match="no picture came .no provider has this model.; try another model"):
        choose_generator("hosted:some/model")(folder, "fail", 0)


def test_without_a_token_a_sentence_asks_for_it(fake_hub):
    fake_hub.get_token = lambda: None
    with pytest.raises(InputError, match="needs a token of huggingface.co; put it into HF_TOKEN"):
        choose_generator("hosted")


def test_without_the_client_a_sentence_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(InputError, match=r"pip install 'oasis-warp\[hosted\]'"):
        choose_generator("hosted:some/model")


class Endpoint(BaseHTTPRequestHandler):
    """An image-to-image endpoint as huggingface_hub speaks to it."""

    def do_POST(self):
        asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.asked.append((asked, self.headers["Authorization"]))
        data = cv2.imencode(".png", GREEN[..., ::-1])[1].tobytes()
        self.send_response(200)
        self.send_header("Content-Type", "image/png")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format, *args):
        pass


def test_the_real_client_speaks_to_an_endpoint(folder, monkeypatch):
    pytest.importorskip("huggingface_hub")
    pytest.importorskip("PIL")
    monkeypatch.setenv("HF_TOKEN", "hf_x")
    with ThreadingHTTPServer(("127.0.0.1", 0), Endpoint) as server:
        server.asked = []
        threading.Thread(target=server.serve_forever, daemon=True).start()
        photo = choose_generator(f"hosted:http://127.0.0.1:{server.server_port}/")(folder, "a pale hand", 3)
        server.shutdown()
    ((asked, token),) = server.asked
    assert base64.b64decode(asked["inputs"]) == (folder / "depth.png").read_bytes()
    assert asked["parameters"]["prompt"].startswith("a pale hand") and asked["parameters"]["seed"] == 3
    assert token == "Bearer hf_x"
    assert np.array_equal(photo.rgb.numpy(), GREEN)
