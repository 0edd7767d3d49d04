"""The whole network: switches, invariances, what an untrained one draws, and what it costs."""

from dataclasses import replace
from typing import NamedTuple

import pytest
import torch

from oasis_warp.avatar.observation import CropBatch, observe_batch
from oasis_warp.network.config import COMPACT, PAPER, NetworkConfig
from oasis_warp.network.hand_network import HandNetwork, Prediction

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
