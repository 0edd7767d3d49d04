"""From words to an avatar: what steers a generator, what is done with its picture; tiny ones of diffusers and hosts."""

import base64
import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import cv2
import numpy as np
import pytest
import torch

from oasis_warp.cli import main
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.estimation.keypoints import read_keypoints
from oasis_warp.reconstruction import reconstruct
from oasis_warp.text import FARTHEST, NEAREST, choose_generator, imagine, make_conditioning, write_conditioning

PAINTER = Path(__file__).parent / "paint_hand.py"
PAINT = f"{sys.executable} {PAINTER} {{folder}} {{prompt}} {{seed}} {{out}}"
GREEN = np.full((8, 8, 3), (0, 200, 0), np.uint8)


@pytest.fixture(scope="module", params=["right", "left"])
def asked(request, hand):
    return make_conditioning(hand, side=request.param, size=256)


def test_the_pose_file_puts_the_hand_where_the_pictures_show_it(asked, hand, tmp_path):
    write_conditioning(tmp_path, asked)
    photo = read_photo(tmp_path / "depth.png")
    fit = read_keypoints(tmp_path / "pose.json", photo, hand=hand)
    assert fit.side == asked.side
    assert torch.allclose(fit.landmarks.xy, asked.landmarks, atol=0.1)
    tips = asked.landmarks[4::4].round().long()
    assert (asked.mask[tips[:, 1], tips[:, 0]] == 1).all()
    thumb, little = asked.landmarks[4, 0], asked.landmarks[20, 0]
    assert (thumb > little) == (asked.side == "right")  # of a palm with its fingers up


def test_near_is_bright_and_normals_point_to_the_viewer(asked):
    on = asked.mask > 0
    assert asked.depth[~on].max() == 0 and asked.depth[on].min() > FARTHEST - 0.2
    assert asked.depth.max() == pytest.approx(NEAREST, abs=0.01)
    assert asked.normals[on][:, 2].min() >= 0.5
    columns = asked.mask.sum(0).nonzero()[:, 0]
    row = int(asked.landmarks[9, 1])  # through the middle knuckle
    across = asked.normals[row, :, 0][on[row]]
    assert across[0] < 0.3 and across[-1] > 0.7, columns  # left edges face left


def test_the_forearm_leaves_the_picture(asked):
    assert asked.mask[-1].sum() > 40


def test_the_generator_is_asked_again_until_the_hand_is_there(hand, tmp_path):
    asked = make_conditioning(hand, size=256)
    write_conditioning(tmp_path, asked)
    made = imagine(choose_generator(PAINT), HandEstimator(hand), asked, tmp_path, "a pale hand", seed=13, tries=2)
    assert made.seed == 14 and made.distance < 5
    with pytest.raises(InputError, match=r"no picture shows a right hand .*seed 13: no right hand found\); try other"):
        imagine(choose_generator(PAINT), HandEstimator(hand), asked, tmp_path, "a pale hand", seed=13, tries=1)


def test_another_pose_and_another_side_are_refused(hand, tmp_path):
    write_conditioning(tmp_path, make_conditioning(hand, "victory", size=256))
    estimator, paint = HandEstimator(hand), choose_generator(PAINT)
    with pytest.raises(InputError, match="the landmarks are [1-9][0-9]* % of the hand's size off"):
        imagine(paint, estimator, make_conditioning(hand, size=256), tmp_path, "a pale hand", tries=1)
    with pytest.raises(InputError, match="no left hand found"):
        left = make_conditioning(hand, "victory", side="left", size=256)
        imagine(paint, estimator, left, tmp_path, "a pale hand", tries=1)


@pytest.mark.slow
def test_the_skin_of_the_avatar_follows_the_words(hand, tmp_path):
    asked, estimator, colors = make_conditioning(hand, size=256), HandEstimator(hand), {}
    write_conditioning(tmp_path, asked)
    for skin in ("dark", "pale"):
        made = imagine(choose_generator(PAINT), estimator, asked, tmp_path, f"a {skin} hand")
        avatar = reconstruct(made.photo, ReconstructConfig(size=96, steps=10), keypoints=tmp_path / "pose.json").avatar
        colors[skin] = avatar.gaussians.colors.mean(0)
        assert torch.equal(avatar.source_pose.angles, asked.pose.angles)
    assert (colors["pale"] - colors["dark"]).min() > 0.25


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            "nothing",
            "expected a picture, a folder with a diffusers pipeline, hosted:MODEL, or a command with {out}",
        ),
        ("paint 'unfinished {out}", "cannot be read as a command"),
    ],
)
def test_what_is_no_generator_is_refused(given, said):
    with pytest.raises(InputError, match=said.replace("{", r"\{").replace("}", r"\}")):
        choose_generator(given)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("no_such_program {out}", "cannot be started"),
        (f'{sys.executable} -c "raise SystemExit(chr(110))" {{out}}', "wrote no picture .exit code 1: n"),
        (f'{sys.executable} -c "" {{out}}', "wrote no picture .exit code 0: it said nothing"),
    ],
)
def test_a_command_that_fails_is_said(command, said, tmp_path):
    with pytest.raises(InputError, match=said):
        choose_generator(command)(tmp_path, "words", 0)


def test_words_reach_the_command_as_they_are_and_no_shell(tmp_path):
    program = (
        "import sys, cv2, numpy; cv2.imwrite(sys.argv[1], numpy.zeros((32, 32, 3)));"
        "open(sys.argv[2], 'w').write(sys.argv[3])"
    )
    noted = tmp_path / "said.txt"
    words = "$(touch x); 'quoted' {seed} {out}"
    picture = choose_generator(f'{sys.executable} -c "{program}" {{out}} {noted} {{prompt}}')(tmp_path, words, 7)
    assert picture.rgb.shape == (32, 32, 3)
    assert noted.read_text() == words


def test_without_a_generator_the_files_are_left_and_the_next_step_is_said(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["text", "an old fisherman's tanned hand", "-o", str(out), "--view", "back", "--size", "256"]) == 0
    assert {path.name for path in out.iterdir()} == {
        "depth.png", "normal.png", "canny.png", "mask.png", "pose.json", "prompt.txt",
    }  # fmt: skip
    assert "--generator PICTURE" in capsys.readouterr().err
    assert (out / "prompt.txt").read_text().startswith("an old fisherman's tanned hand, photo of the back of one right")
    assert json.loads((out / "pose.json").read_text())["side"] == "right"
    assert np.ptp(cv2.imread(str(out / "canny.png"))) == 255


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--size", "64"], "--size 64: expected 256 to 4096 pixels"),
        (["--tries", "0"], "--tries 0: expected at least 1"),
        (["--generator", "nothing"], "--generator nothing: expected a picture"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_written(options, said, tmp_path, capsys):
    assert main(["text", "a hand", "-o", str(tmp_path / "out"), *options]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


CHANNELS, WORDS = (32, 64), 32


@pytest.fixture(scope="module")
def pipeline_folder(tmp_path_factory):
    diffusers, transformers = pytest.importorskip("diffusers"), pytest.importorskip("transformers")
    folder = tmp_path_factory.mktemp("pipeline")
    letters = [chr(code) for code in range(33, 127)]
    vocabulary = ["<|startoftext|>", "<pad>", "<|endoftext|>", *letters, *(letter + "</w>" for letter in letters)]
    (folder / "vocab.json").write_text(json.dumps({word: k for k, word in enumerate(vocabulary)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    names = [str(folder / name) for name in ("vocab.json", "merges.txt")]
    tokenizer = transformers.CLIPTokenizer(*names, unk_token="<|endoftext|>", model_max_length=77)
    torch.manual_seed(0)
    common = {
        "block_out_channels": CHANNELS, "layers_per_block": 1, "in_channels": 4, "cross_attention_dim": WORDS,
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"), "norm_num_groups": 8,
    }  # fmt: skip
    unet = diffusers.UNet2DConditionModel(
        **common, out_channels=4, sample_size=32, up_block_types=("CrossAttnUpBlock2D", "UpBlock2D")
    )
    control = diffusers.ControlNetModel(**common, conditioning_embedding_out_channels=(16, 32))
    for name, weights in control.named_parameters():
        if "controlnet" in name:  # zero at first: depth would change nothing
            torch.nn.init.normal_(weights, std=0.3)
    vae = diffusers.AutoencoderKL(
        block_out_channels=CHANNELS, latent_channels=4, norm_num_groups=8,
        down_block_types=("DownEncoderBlock2D",) * 2, up_block_types=("UpDecoderBlock2D",) * 2,
    )  # fmt: skip
    config = transformers.CLIPTextConfig(
        vocab_size=len(vocabulary), hidden_size=WORDS, intermediate_size=37, num_hidden_layers=2,
        num_attention_heads=4, bos_token_id=0, pad_token_id=1, eos_token_id=2,
    )  # fmt: skip
    pipeline = diffusers.StableDiffusionControlNetPipeline(
        vae=vae, text_encoder=transformers.CLIPTextModel(config), tokenizer=tokenizer, unet=unet, controlnet=control,
        scheduler=diffusers.DDIMScheduler(), safety_checker=None, feature_extractor=None,
        requires_safety_checker=False,
    )  # fmt: skip
    pipeline.save_pretrained(folder / "saved")
    return folder / "saved"


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_the_picture_follows_depth_and_seed(pipeline_folder, hand, tmp_path):
    generate = choose_generator(str(pipeline_folder))
    made = {}
    for pose in ("open", "fist"):
        (tmp_path / pose).mkdir()
        write_conditioning(tmp_path / pose, make_conditioning(hand, pose, size=64))
        made[pose] = generate(tmp_path / pose, "an old hand", 3).rgb
    assert made["open"].shape == (64, 64, 3)
    assert torch.equal(generate(tmp_path / "fist", "an old hand", 3).rgb, made["fist"])
    assert (made["open"].float() - made["fist"].float()).abs().mean() > 3


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_folder_without_a_pipeline_is_refused(tmp_path):
    pytest.importorskip("diffusers")
    with pytest.raises(InputError, match="expected a diffusers pipeline"):
        choose_generator(str(tmp_path))


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
