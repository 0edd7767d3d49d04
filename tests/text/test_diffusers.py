"""A pipeline of diffusers as the generator: tiny, with random weights, saved to a folder and read from there."""

import json

import pytest
import torch

from oasis_warp.core.errors import InputError
from oasis_warp.text import choose_generator, make_conditioning
from oasis_warp.text.conditioning import write_conditioning

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]  # theirs
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


def test_a_folder_without_a_pipeline_is_refused(tmp_path):
    pytest.importorskip("diffusers")
    with pytest.raises(InputError, match="expected a diffusers pipeline"):
        choose_generator(str(tmp_path))
