"""Weights files: what goes in comes out, and what does not fit is refused in one sentence."""

import json
import resource
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save, save_file

from oasis_warp.core.errors import InputError
from oasis_warp.network.encoders import SIZES, Size
from oasis_warp.network.weights_file import FORMAT, load_network, save_network, trained_state


@pytest.fixture(scope="module")
def stored(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_network(path, network, notes="a test")
    return path


def header_of(path):
    size = int.from_bytes(path.read_bytes()[:8], "little")
    return json.loads(json.loads(path.read_bytes()[8 : 8 + size])["__metadata__"][FORMAT])


def rewritten(stored, tmp_path, change_header=None, change_tensors=None):
    header, tensors = header_of(stored), load_file(stored)
    (change_header or dict.items)(header)
    (change_tensors or dict.items)(tensors)
    path = tmp_path / "other.safetensors"
    path.write_bytes(save(tensors, {FORMAT: json.dumps(header)}))
    return path


def test_a_loaded_network_draws_what_the_saved_one_drew(network, stored, hand, batch):
    loaded = load_network(stored, hand)
    assert loaded.config == network.config
    for name, tensor in trained_state(loaded).items():
        assert torch.equal(tensor, trained_state(network)[name].half().float()), name
    with torch.no_grad():
        for a, b in zip(network(batch), loaded(batch), strict=True):
            assert float((a - b).abs().mean()) < 2e-3 * float(a.abs().mean() + 1e-6)


def test_full_precision_loses_no_bit(network, tmp_path, hand):
    save_network(tmp_path / "full.safetensors", network, precision="float32")
    loaded = load_network(tmp_path / "full.safetensors", hand)
    assert all(torch.equal(trained_state(loaded)[k], v) for k, v in trained_state(network).items())


def test_the_same_network_is_the_same_file(network, stored, tmp_path):
    save_network(tmp_path / "again.safetensors", network, notes="a test")
    assert (tmp_path / "again.safetensors").read_bytes() == stored.read_bytes()


def test_the_header_tells_what_the_file_is(stored, network):
    header = header_of(stored)
    assert (header["version"], header["hand_model"], header["notes"]) == (1, "bundled", "a test")
    assert header["config"]["profile"] == network.config.profile == "compact"


def test_a_frozen_backbone_stays_in_its_own_file(monkeypatch, make_network, tiny, tmp_path, hand):
    monkeypatch.setitem(SIZES, "dinov2-small", Size(32, 1, 2))
    network = make_network(replace(tiny, backbone="dinov2-small", image_size=56))
    path = tmp_path / "paper.safetensors"
    save_network(path, network)
    assert not any(name.startswith("encoder.") for name in load_file(path))
    with pytest.raises(InputError, match="reads photos with dinov2-small; give the file of its weights too"):
        load_network(path, hand)
    backbone = tmp_path / "model.safetensors"
    save_file({name: tensor + 0 for name, tensor in network.encoder.state_dict().items()}, backbone)
    loaded = load_network(path, hand, backbone_weights=backbone)
    torch.testing.assert_close(loaded.encoder.state_dict(), network.encoder.state_dict())


def newer(header):
    header["version"] = 2


def nameless(header):
    del header["hand_model"]


def unknown_switch(header):
    header["config"]["magic"] = "on"


def other_hand(header):
    header["hand_model"], header["n_vertices"] = "mano", 778


def one_missing(tensors):
    tensors.pop("vertex_head.last.bias")


def one_too_many(tensors):
    tensors["zzz"] = torch.zeros(1)


def wrong_shape(tensors):
    tensors["vertex_head.last.bias"] = torch.zeros(3)


def not_finite(tensors):
    tensors["vertex_head.last.bias"] = tensors["vertex_head.last.bias"] * float("nan")


def many_tokens(header):
    header["config"]["n_tokens"] = 6_000_000


def many_layers(header):
    header["config"]["refine_layers"] = 30
    header["config"]["width"] = 2048


def true_layers(header):
    header["config"]["refine_layers"] = True


def half_a_version(header):
    header["version"] = 1.5


def long_name(header):
    header["hand_model"] = "\x1b[31m" * 100_000


def whole_numbers(tensors):
    tensors["vertex_head.last.bias"] = tensors["vertex_head.last.bias"].to(torch.int32)


@pytest.mark.parametrize(
    ("header", "tensors", "message"),
    [
        (many_tokens, None, "n_tokens: expected a whole number from 1 to 4096, got 6000000"),
        (many_layers, None, "holds fewer weights than the network that its header describes; copy it again"),
        (true_layers, None, "refine_layers: expected a whole number from 1 to 32, got True"),
        (half_a_version, None, "damaged, its header has no valid version"),
        (long_name, None, "trained for the hand model"),
        (None, whole_numbers, "vertex_head.last.bias holds torch.int32 instead of real numbers"),
        (newer, None, "a network of version 2, but 1 is the last known here; update oasis-warp."),
        (nameless, None, "damaged, its header has no valid hand_model; copy it again."),
        (unknown_switch, None, "its header describes no network known here .*magic"),
        (other_hand, None, r"trained for the hand model 'mano' \(778 vertices, .*'bundled' \(12337"),
        (None, one_missing, "1 tensors do not fit the network that the header describes, vertex_head.last.bias first"),
        (None, one_too_many, "1 tensors do not fit the network that the header describes, zzz first"),
        (None, wrong_shape, "1 tensors do not fit the network that the header describes, vertex_head.last.bias first"),
        (None, not_finite, "damaged, vertex_head.last.bias holds values that are not finite"),
    ],
)
def test_files_that_do_not_fit_are_refused(stored, tmp_path, hand, header, tensors, message):
    path = rewritten(stored, tmp_path, header, tensors)
    with pytest.raises(InputError, match=message) as caught:
        load_network(path, hand)
    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 1100


@pytest.mark.parametrize("text", ["", "[" * 100_000, "[]", f'{{"version": {"1" * 5000}}}', '{"version": NaN}'])
def test_a_header_that_cannot_be_read_is_refused(stored, tmp_path, hand, text):
    save_file(load_file(stored), tmp_path / "own.safetensors", {FORMAT: text})
    with pytest.raises(InputError, match="damaged, its header cannot be read"):
        load_network(tmp_path / "own.safetensors", hand)


def test_no_memory_is_taken_for_a_network_larger_than_its_file(stored, tmp_path, hand):
    path = rewritten(stored, tmp_path, many_layers, None)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="holds fewer weights"):
        load_network(path, hand)
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10 < 300 << 20


def test_what_is_no_weights_file_is_refused(stored, tmp_path, hand):
    with pytest.raises(InputError, match="expected a network's weights, found no such file"):
        load_network(tmp_path / "none", hand)
    with pytest.raises(InputError, match="expected a network's weights, found a folder"):
        load_network(tmp_path, hand)
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(stored.read_bytes()[:-100])
    with pytest.raises(InputError, match="got another format or a file cut short"):
        load_network(cut, hand)
    other = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(1)}, other)
    with pytest.raises(InputError, match="a safetensors file, but no network of ours"):
        load_network(other, hand)


def test_weights_that_half_precision_cannot_hold_are_not_written(make_network, tiny, tmp_path):
    network = make_network(tiny)
    network.vertex_head.last.bias.data[0] = 1e6
    with pytest.raises(ValueError, match="expected weights that float16 can hold, got others in vertex_head.last.bias"):
        save_network(tmp_path / "bad.safetensors", network)
    assert not (tmp_path / "bad.safetensors").exists()
