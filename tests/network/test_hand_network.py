"""The whole network: switches, invariances, cost, and weights files, which refuse what does not fit."""

import json
import resource
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from disk import trust
from safetensors.torch import load_file, save, save_file

from oasis_warp.avatar.observation import CropBatch, observe_batch
from oasis_warp.core.errors import InputError
from oasis_warp.network.config import COMPACT, PAPER, NetworkConfig
from oasis_warp.network.encoders import SIZES, Size
from oasis_warp.network.hand_network import HandNetwork, Prediction
from oasis_warp.network.weights_file import FORMAT, load_network, save_network, trained_state

SWITCHES = {
    "vet": ("no_aggr", "mlp", "off"),
    "tokenizer": ("literal",),
    "vpia": ("no_bias", "off"),
    "visibility": ("literal",),
    "refine": ("off",),
    "fom": ("off",),
    "point_evidence": ("off",),
}
ABLATIONS = [(switch, value) for switch, values in SWITCHES.items() for value in values]


def parts(network):
    """Names of the modules that hold weights, one level down, and how many weights each has."""
    return {name: sum(p.numel() for p in module.parameters()) for name, module in network.named_children()}


@torch.no_grad()
def run(network, batch):
    return network(batch)


class Ablated(NamedTuple):
    switch: str
    value: str
    network: HandNetwork


@pytest.fixture(scope="module", params=ABLATIONS, ids="-".join)
def ablated(request, tiny, make_network, network):
    """A network with one switch thrown, and the weights of the full one wherever they fit."""
    switch, value = request.param
    other = make_network(replace(tiny, **{switch: value}))
    own = other.state_dict()
    shared = {k: v for k, v in network.state_dict().items() if k in own and own[k].shape == v.shape}
    other.load_state_dict(shared, strict=False)
    return Ablated(switch, value, other)


@pytest.fixture(scope="module")
def drawn(network, batch):
    return run(network, batch)


def test_every_ablation_learns_and_draws_something_else(ablated, batch, drawn):
    switch, value, network = ablated
    out = network(batch)
    n_vertices, n_faces = 12_337, 0 if value == "off" and switch == "fom" else 24_608
    assert out.offsets.shape == (2, n_vertices, 3)
    assert out.barycentrics.shape == (2, n_faces, 3)
    assert out.quats.shape == (2, n_vertices + n_faces, 4)
    assert out.opacities.shape == (2, n_vertices + n_faces)
    assert all(bool(part.isfinite().all()) for part in out)
    sum((part * torch.randn_like(part)).sum() for part in out).backward()
    lost = [name for name, parameter in network.named_parameters() if parameter.grad is None]
    assert not lost
    out = Prediction(*(part.detach() for part in out))
    if switch == "fom":  # the vertices know nothing of it
        assert torch.equal(drawn.offsets, out.offsets)
        for x, y in zip(drawn[2:], out[2:], strict=True):
            # The last few of a vector loop round apart.
            torch.testing.assert_close(x[:, :n_vertices], y, atol=1e-6, rtol=0)
    else:
        assert float((drawn.colors - out.colors).abs().mean()) > 1e-6


WEIGHTS_THAT_CHANGE = {
    ("vet", "no_aggr"): set(),
    ("vet", "mlp"): {"tokenizer"},
    ("vet", "off"): {"tokenizer", "flatten"},
    ("tokenizer", "literal"): {"tokenizer"},
    ("vpia", "no_bias"): {"fusion"},
    ("vpia", "off"): {"fusion"},
    ("visibility", "literal"): set(),
    ("refine", "off"): {"refinement"},
    ("fom", "off"): {"feature_on_mesh", "face_head"},
    ("point_evidence", "off"): {"point_evidence", "global_token", "vertex_head", "face_head"},
}


def test_an_ablation_changes_the_weights_of_its_own_part_only(ablated, network):
    full, fewer = parts(network), parts(ablated.network)
    changed = {name for name in full.keys() | fewer.keys() if full.get(name, 0) != fewer.get(name, 0)}
    assert changed == WEIGHTS_THAT_CHANGE[ablated.switch, ablated.value]


def test_an_untrained_network_draws_the_mean_hand_whatever_its_switches(tiny, make_network, batch):
    most = {"vet": "off", "vpia": "off", "refine": "off", "point_evidence": "off"}
    full, bare = (run(make_network(replace(tiny, **change), awake=False), batch) for change in ({}, most))
    assert all(torch.equal(a, b) for a, b in zip(full, bare, strict=True))


def test_the_literal_visibility_scores_the_surface_itself_about_one_half(network, batch):
    margin = observe_batch(batch, network.faces, network.vertex_faces, network.vertex_index)
    literal = observe_batch(batch, network.faces, network.vertex_faces, None)
    seen = margin.confidence > 0.5
    assert float(margin.visibility[seen].mean()) > 0.9
    assert 0.3 < float(literal.visibility[seen].mean()) < 0.75


def test_hands_of_a_batch_do_not_see_each_other(network, batch, drawn):
    for k in range(2):
        alone = run(network, CropBatch(*(part[k : k + 1] for part in batch)))
        for a, b in zip(drawn, alone, strict=True):
            torch.testing.assert_close(a[k], b[0], atol=2e-5, rtol=1e-4)


def test_where_the_world_stands_does_not_matter(network, batch, drawn):
    shift = torch.tensor([0.3, -0.2, 0.5])
    viewmat = batch.viewmat.clone()
    viewmat[:, :3, 3] -= viewmat[:, :3, :3] @ shift
    moved = run(network, batch._replace(posed=batch.posed + shift, viewmat=viewmat))
    for a, b in zip(drawn, moved, strict=True):
        assert float((a - b).abs().mean()) < 1e-4


def test_what_the_mask_hides_changes_nothing(network, batch, drawn):
    noise = torch.rand(batch.image.shape, generator=torch.Generator().manual_seed(0))
    hidden = torch.where(batch.mask[..., None] > 0, batch.image, noise)
    again = run(network, batch._replace(image=hidden))
    # sampled colours at the very outline may mix with the background; what trusts them stays inside the mask
    assert float((drawn.colors - again.colors).abs().max()) < 1e-5


def test_a_photo_without_the_hand_in_frame_still_gives_a_hand(network, batch):
    away = batch.viewmat.clone()
    away[:, 2, 3] -= 10
    out = run(network, batch._replace(viewmat=away))
    assert all(bool(part.isfinite().all()) for part in out)


def test_the_same_input_gives_the_same_bits_forward_and_backward(make_network, tiny, batch):
    def gradients():
        network = make_network(tiny)
        out = network(batch)
        sum(part.square().mean() for part in out).backward()
        return [part.detach() for part in out] + [p.grad for p in network.parameters()]

    assert all(torch.equal(a, b) for a, b in zip(gradients(), gradients(), strict=True))


def test_half_precision_keeps_geometry_exact_and_gaussians_near(network, batch, drawn):
    with torch.autocast("cpu", torch.bfloat16):
        half = run(network, batch)
    assert all(part.dtype == torch.float32 for part in half)
    for a, b in zip(drawn, half, strict=True):
        assert float((a - b).abs().mean()) < 0.02 * float(a.std())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vet": "maybe"}, "vet: expected one of 'on', 'no_aggr', 'mlp', 'off', got 'maybe'"),
        ({"heads": 5}, "heads: expected a number that splits width 192 into multiples of 8, got 5"),
        ({"heads": 48}, "heads: expected a number that splits width 192 into multiples of 8, got 48"),
        ({"n_tokens": 0}, "n_tokens: expected a whole number from 1 to 4096, got 0"),
        ({"width": 192.0}, "width: expected a whole number from 1 to 2048, got 192.0"),
        ({"neighborhood": 4}, "neighborhood: expected an odd number, got 4"),
    ],
)
def test_impossible_sizes_are_refused(change, message, as_shipped):
    with pytest.raises(ValueError, match=message):
        replace(COMPACT, **change)


def test_the_paper_profile_has_the_sizes_of_the_paper():
    assert (PAPER.n_tokens, PAPER.neighborhood, PAPER.frequencies) == (1024, 5, 10)
    assert PAPER.n_coarse is None and PAPER.point_evidence == "off"
    assert PAPER.image_size // 14 == 32
    on = NetworkConfig(**{f: getattr(PAPER, f) for f in PAPER.__dataclass_fields__})
    assert (on.vet, on.vpia, on.refine, on.fom) == ("on",) * 4


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
    trust(backbone)
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


def odd_size(header):
    header["config"]["image_size"] = 250


def many_points(header):
    header["config"]["n_coarse"] = 12_338


def few_points(header):
    header["config"]["n_coarse"] = 15


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
        (odd_size, None, "no network known here .image_size: expected a multiple of 16, got 250"),
        (many_points, None, "no network known here .n_coarse: expected 16 to"),
        (few_points, None, "no network known here .n_coarse: expected 16 to"),
        (many_layers, None, "holds fewer weights than the network that its header describes; copy it again"),
        (true_layers, None, "refine_layers: expected a whole number from 1 to 32, got True"),
        (half_a_version, None, "damaged, its header has no valid version"),
        (long_name, None, "trained for the hand model"),
        (None, whole_numbers, "vertex_head.last.bias holds torch.int32 instead of real numbers"),
        (newer, None, "a network of version 2, newer than the known 1; update oasis-warp."),
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
    with pytest.raises(InputError, match="a safetensors file, but not a network"):
        load_network(other, hand)


def test_weights_that_half_precision_cannot_hold_are_not_written(make_network, tiny, tmp_path):
    network = make_network(tiny)
    network.vertex_head.last.bias.data[0] = 1e6
    with pytest.raises(ValueError, match="expected weights that float16 can hold, got others in vertex_head.last.bias"):
        save_network(tmp_path / "bad.safetensors", network)
    assert not (tmp_path / "bad.safetensors").exists()
