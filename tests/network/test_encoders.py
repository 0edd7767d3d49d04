"""Image encoders: our own, and DINOv2 from a file."""

import pytest
import torch
from safetensors.torch import save_file
from torch.utils._python_dispatch import TorchDispatchMode

from oasis_warp.core.errors import InputError
from oasis_warp.losses.lpips import Lpips
from oasis_warp.network.encoders import SIZES, ConvolutionalEncoder, DinoV2Encoder, Size


@pytest.fixture
def photo(random):
    mask = torch.zeros(2, 64, 64)
    mask[:, 20:50, 10:40] = 1
    return torch.rand(2, 64, 64, 3, generator=random), mask


@pytest.fixture
def small_dino(monkeypatch):
    monkeypatch.setitem(SIZES, "dinov2-small", Size(32, 2, 2))
    torch.manual_seed(0)
    return DinoV2Encoder("dinov2-small", 56)


def encoders():
    torch.manual_seed(0)
    return ConvolutionalEncoder(64, 32)


def published(encoder, spelling):
    """The encoder's random weights under the names of the public files."""
    names = {
        "files": {"query": "attention.attention.query", "key": "attention.attention.key",
                  "value": "attention.attention.value", "output": "attention.output.dense"},
        "library": {"query": "attention.q_proj", "key": "attention.k_proj", "value": "attention.v_proj",
                    "output": "attention.o_proj"},
    }[spelling]  # fmt: skip
    out = {"embeddings.mask_token": torch.zeros(1, 32)}
    for name, tensor in encoder.state_dict().items():
        tensor = torch.randn(tensor.shape, generator=torch.Generator().manual_seed(len(out)))
        part = name.split(".")
        if part[0] == "blocks":
            theirs = {"scale1": "layer_scale1.lambda1", "scale2": "layer_scale2.lambda1", "fc1": "mlp.fc1",
                      "fc2": "mlp.fc2", **names}.get(part[2], part[2])  # fmt: skip
            name = ".".join(["encoder", "layer", part[1], theirs, *part[3:]])
        else:
            name = {"cls": "embeddings.cls_token", "position": "embeddings.position_embeddings",
                    "patch.weight": "embeddings.patch_embeddings.projection.weight",
                    "patch.bias": "embeddings.patch_embeddings.projection.bias",
                    "norm.weight": "layernorm.weight", "norm.bias": "layernorm.bias"}[name]  # fmt: skip
        out[name] = tensor
    return out


def test_maps_have_their_strides(photo):
    features = encoders()(*photo)
    assert features.aligned.shape == (2, 32, 16, 16)
    assert features.deep.shape == (2, 256, 4, 4)
    assert features.fine.shape == (2, 16, 64, 64)


def test_what_stands_behind_the_hand_is_not_seen(photo, small_dino):
    image, mask = photo
    other = torch.where(mask[..., None] > 0, image, 1 - image)
    for encoder in (encoders(), small_dino):
        assert torch.equal(encoder(image, mask).aligned, encoder(other, mask).aligned)
        assert not torch.equal(encoder(image, mask).aligned, encoder(1 - image, mask).aligned)


def test_a_crop_of_another_size_is_resampled(photo):
    image, mask = (torch.nn.functional.interpolate(
        part, size=(128, 128), mode="nearest"
    ) for part in (photo[0].permute(0, 3, 1, 2), photo[1][:, None]))  # fmt: skip
    encoder = encoders()
    large = encoder(image.permute(0, 2, 3, 1), mask[:, 0])
    assert large.aligned.shape == (2, 32, 16, 16)
    same = encoder(*photo).aligned.detach()
    assert float((large.aligned.detach() - same).abs().mean()) < 0.2 * float(same.std())


def test_every_weight_of_our_encoder_learns(photo):
    encoder = encoders()
    sum(part.square().mean() for part in encoder(*photo)).backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in encoder.parameters())


def test_sizes_that_do_not_divide_are_refused():
    with pytest.raises(ValueError, match="image_size: expected a multiple of 16, got 100"):
        ConvolutionalEncoder(100, 32)
    with pytest.raises(ValueError, match="image_size: expected a multiple of 14, got 100"):
        DinoV2Encoder("dinov2-small", 100)


@pytest.mark.parametrize("spelling", ["files", "library"])
def test_published_weights_land_where_they_belong(small_dino, tmp_path, spelling, photo):
    path = tmp_path / "model.safetensors"
    weights = published(small_dino, spelling)
    save_file(weights, path)
    before = small_dino(*photo).aligned
    small_dino.load(path)
    after = small_dino(*photo).aligned
    assert after.shape == (2, 32, 4, 4)
    assert not torch.allclose(before, after)
    torch.testing.assert_close(small_dino.blocks[1].fc1.weight, weights["encoder.layer.1.mlp.fc1.weight"])
    name = {"files": "attention.attention.key", "library": "attention.k_proj"}[spelling]
    torch.testing.assert_close(small_dino.blocks[0].key.weight, weights[f"encoder.layer.0.{name}.weight"])


def test_a_backbone_is_frozen(small_dino, photo):
    assert not any(parameter.requires_grad for parameter in small_dino.parameters())
    assert not small_dino(*photo).aligned.requires_grad


class Brought(TorchDispatchMode):
    """Counts tensors that are made of the host's numbers."""

    count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += "lift_fresh" in str(func)
        return func(*args, **(kwargs or {}))


def test_frozen_networks_can_be_recorded_on_cuda_since_they_bring_no_numbers_from_the_host(small_dino, photo):
    (image, mask), lpips = photo, Lpips()
    with Brought() as brought:
        small_dino(image, mask)
        lpips(image, image.flip(1), mask)
        assert brought.count == 0
        torch.tensor([1.0])  # is counted
    assert brought.count == 1


def test_files_that_hold_no_such_backbone_are_refused(small_dino, tmp_path):
    with pytest.raises(InputError, match=r"none: expected DINOv2 ViT-./14, found no such file"):
        small_dino.load(tmp_path / "none")
    text = tmp_path / "text.safetensors"
    text.write_text("hello")
    with pytest.raises(InputError, match="expected the weights of DINOv2, got another format"):
        small_dino.load(text)
    other = tmp_path / "other.safetensors"
    weights = published(small_dino, "files")
    save_file({**weights, "embeddings.register_tokens": torch.zeros(1, 4, 32)}, other)
    with pytest.raises(InputError, match="width 32 and 2 layers without registers, but 1 tensors differ"):
        small_dino.load(other)


def test_positions_are_interpolated_to_the_grid_of_the_crop(small_dino):
    torch.nn.init.zeros_(small_dino.patch.weight)
    small_dino.position.data[:, 1:] = torch.linspace(-1, 1, 37).expand(37, 37).reshape(1, -1, 1)  # grows along x
    for block in small_dino.blocks:
        block.scale1.data.zero_()
        block.scale2.data.zero_()
    small_dino.norm = torch.nn.Identity()
    features = small_dino(torch.rand(1, 56, 56, 3), torch.ones(1, 56, 56)).aligned
    middle = features[0, :, 1:3].mean((0, 1)) - small_dino.patch.bias.mean()
    assert bool((middle.diff() > 0.3).all())
    assert float(features.var(2).max()) < 1e-6
