"""The network at the seam of priors."""

import hashlib
import json
import pickle
from dataclasses import replace
from importlib import resources

import pytest
import torch

from oasis_warp.adaptation.adapt import adapt
from oasis_warp.assets import asset
from oasis_warp.avatar.anchors import OPACITY, RIM_FADE, rim_fade
from oasis_warp.avatar.densify import GROUND_DEPTH
from oasis_warp.avatar.observation import batch_of_crop
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.avatar.prior import MeanPrior, Prior
from oasis_warp.core import rotation, surface
from oasis_warp.core.config import AdaptConfig
from oasis_warp.core.errors import InputError
from oasis_warp.losses import masked_psnr
from oasis_warp.network import prior as home
from oasis_warp.network.prior import (
    MAX_SCALE,
    RIM_FIRST,
    RIM_LAST,
    NetworkPrior,
    RestSurface,
    all_gaussians,
    blend_rim,
    bundled_prior,
    canonical_gaussians,
    choose_prior,
    clamp_to_surface,
    color_sources,
    cover_surface,
)
from oasis_warp.network.weights_file import read_header, save_network
from oasis_warp.render import render


def covariances(gaussians):
    half = rotation.to_matrix(gaussians.quats) * gaussians.scales[:, None, :]
    return half @ half.transpose(1, 2)


@pytest.fixture(scope="module")
def untrained(make_network, tiny):
    return NetworkPrior(make_network(tiny, awake=False))


def surface_of(network, crop):
    return RestSurface(crop.rest.vertices, network.faces, network.vertex_faces, network.rim)


def on_gpu(value):
    if isinstance(value, torch.Tensor):
        return value.to("cuda")
    return type(value)(*map(on_gpu, value)) if isinstance(value, tuple) else value


@pytest.mark.gpu
def test_a_prior_that_was_recorded_can_be_sent_to_other_processes(make_network, tiny, crops):
    prior, there = NetworkPrior(make_network(tiny), {"name": "tiny"}), on_gpu(crops[0])
    guess = [prior(there) for _ in range(3)][-1]
    torch.testing.assert_close(pickle.loads(pickle.dumps(prior))(there).colors, guess.colors)


@pytest.mark.parametrize("which", [0, 1])
def test_an_untrained_network_is_the_mean_prior(untrained, hand, crops, which):
    assert isinstance(untrained, Prior)
    ours, mean = untrained(crops[which]), MeanPrior(hand)(crops[which])
    for field in ("vertex_index", "face_index"):
        assert torch.equal(getattr(ours, field), getattr(mean, field))
    torch.testing.assert_close(ours.barycentrics, mean.barycentrics)
    torch.testing.assert_close(ours.opacities, mean.opacities, atol=1e-6, rtol=1e-5)
    rest, n = crops[which].rest.vertices, len(mean.vertex_index)  # those of faces; vertices carry discs
    torch.testing.assert_close(ours.scales[n:], mean.scales[n:], atol=1e-8, rtol=1e-4)
    beyond = torch.cdist(rest, rest[hand.rim]).amin(1)[hand.faces[mean.face_index]].amin(1) >= RIM_LAST * RIM_FADE
    torch.testing.assert_close(ours.colors[n:][beyond], mean.colors[n:][beyond], atol=2e-3, rtol=0)
    ours, mean = covariances(ours)[n:], covariances(mean)[n:]
    assert float(((ours - mean).abs().amax((1, 2)) / mean.abs().amax((1, 2))).max()) < 2e-5


def test_the_rim_takes_over_the_colours_beyond_it(hand):
    rest = hand.template
    from_rim = torch.cdist(rest, rest[hand.rim]).amin(1)
    shades = torch.where(from_rim < RIM_FADE, 0.1, 0.5 + 0.1 * rest[:, 2] / rest[:, 2].abs().amax())
    colors = torch.cat([shades, shades[hand.faces].amin(1)])[:, None].expand(-1, 3)
    for count in (len(colors), len(rest)):  # with face Gaussians and without
        away = torch.cat([from_rim, from_rim[hand.faces].amin(1)])[:count]
        spread = colors[color_sources(rest, hand.faces, away)]
        assert float(spread.min()) > 0.38
        near = from_rim < RIM_LAST * RIM_FADE
        assert torch.equal(spread[: len(rest)][~near], colors[: len(rest)][~near])
        wanted = 0.5 + 0.1 * rest[near, 2] / rest[:, 2].abs().amax()
        assert float((spread[: len(rest)][near, 0] - wanted).abs().max()) < 0.05


def test_at_the_wrists_end_gaussians_have_the_shapes_of_their_anchors(network, hand, crops):
    with torch.no_grad():
        prediction = network(batch_of_crop(crops[0]))
    rest = crops[0].rest.vertices
    settled = blend_rim(prediction, surface_of(network, crops[0]))
    at_vertices = torch.cdist(rest, rest[hand.rim]).amin(1)
    from_rim = torch.cat([at_vertices, at_vertices[hand.faces].amin(1)])
    near, far = from_rim <= RIM_FIRST * RIM_FADE, from_rim >= RIM_LAST * RIM_FADE
    torch.testing.assert_close(settled.scales[0, near], prediction.anchor_scales[0, near])
    assert not settled.offsets[0, near[: len(rest)]].any()
    assert float(settled.opacities[0, near].max()) <= OPACITY + 1e-6
    assert not torch.allclose(prediction.scales[0, near], prediction.anchor_scales[0, near], rtol=1e-3)
    for name in ("quats", "scales", "opacities"):
        torch.testing.assert_close(getattr(settled, name)[0, far], getattr(prediction, name)[0, far])
    assert torch.equal(settled.offsets[0, far[: len(rest)]], prediction.offsets[0, far[: len(rest)]])


def test_no_gaussian_floats_off_the_skin(network, hand, crops):
    """Large ones, and ones far above the surface, were haze between the fingers."""
    prior, crop = NetworkPrior(network), crops[0]
    with torch.no_grad():
        wild = prior._predict(crop)
    wild = wild._replace(offsets=0.006 * torch.sign(wild.offsets + 1e-9), scales=wild.scales + 0.004)
    rest = crop.rest.vertices
    clamped = clamp_to_surface(wild, surface_of(network, crop))
    above = (clamped.offsets[0] * surface.vertex_normals(rest, network.faces)).sum(-1)
    assert float(above.max()) < 1e-6
    assert float(clamped.scales.max()) <= 1.001 * MAX_SCALE
    guess = prior(crop)
    assert float(guess.scales[len(guess.vertex_index) :].max()) <= 1.001 * MAX_SCALE


def test_vertices_carry_opaque_discs_below_the_skin(network, hand, crops):
    """The network's own were faint, black, or stood out of bent knuckles as fog; none of that is left."""
    crop, n = crops[0], len(hand.template)
    with torch.no_grad():
        prediction = NetworkPrior(network)._predict(crop)
    opacities, colors = prediction.opacities.clone(), torch.full_like(prediction.colors, 0.6)
    opacities[0, :n], colors[0, :n] = 1e-4, 0.0
    astray = prediction.offsets + 0.002
    covered = cover_surface(
        prediction._replace(opacities=opacities, colors=colors, offsets=astray), surface_of(network, crop)
    )
    fade = rim_fade(crop.rest.vertices[None], network.rim)[0]
    torch.testing.assert_close(covered.opacities[0, :n], OPACITY * fade)
    assert float((covered.colors[0, :n][fade > 0.1] - 0.6).abs().max()) < 1e-3
    normals = surface.vertex_normals(crop.rest.vertices, network.faces)
    torch.testing.assert_close(covered.offsets[0], -GROUND_DEPTH * normals, atol=1e-6, rtol=0)
    thin = rotation.to_matrix(covered.quats[0, :n])[..., 2]
    assert float((thin * normals).sum(-1).abs().min()) > 0.99  # they lie in the skin
    torch.testing.assert_close(covered.scales[0, n:], prediction.scales[0, n:], atol=0, rtol=0)


def test_faint_gaussians_are_left_out_of_an_avatar_and_kept_for_training(untrained, hand, crops):
    with torch.no_grad():
        prediction = untrained.network(batch_of_crop(crops[0]))
    few = canonical_gaussians(prediction, 0)
    every_vertex, every_face = torch.arange(len(hand.template)), torch.arange(len(hand.faces))
    everything = all_gaussians(prediction, 0, every_vertex, every_face)
    assert len(few.opacities) < len(everything.opacities) == 36_945
    crop = crops[0]
    pictures = [
        render(pose_gaussians(g, hand.faces, crop.rest.vertices, crop.posed.vertices), crop.camera).image
        for g in (few, everything)
    ]
    torch.testing.assert_close(*pictures, atol=1e-6, rtol=0)


def test_its_guess_can_be_adapted_to_the_photo(network, hand, crops):
    crop = crops[0]
    guess = NetworkPrior(network)(crop)
    done = adapt(hand, [guess], [crop], AdaptConfig(calibration_steps=5, texture_steps=5))

    def psnr(gaussians):
        posed = pose_gaussians(gaussians, hand.faces, crop.rest.vertices, crop.posed.vertices)
        return masked_psnr(render(posed, crop.camera).image.clamp(0, 1), crop.image, crop.mask)

    assert psnr(done.gaussians) > psnr(guess)


@pytest.fixture(scope="module")
def weights(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "network.safetensors"
    save_network(path, network, notes=json.dumps({"step": 1200, "seed": 3}))
    return path


@pytest.fixture
def bundle(monkeypatch):
    """Put another file where the bundled weights lie."""

    def put(path):
        monkeypatch.setattr(home, "asset", lambda *parts: path)
        bundled_prior.cache_clear()

    yield put
    bundled_prior.cache_clear()


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_prior_is_chosen_by_word_or_by_file(weights, bundle, network, crops):
    bundle(weights)
    learned, none, own = choose_prior("learned"), choose_prior("none"), choose_prior(weights)
    assert learned.about == {"name": "learned", "sha256": digest(weights), "step": 1200}
    assert own.about == {"name": str(weights), "sha256": digest(weights), "step": 1200}
    assert none.about == {"name": "none"}
    assert isinstance(none, MeanPrior)
    ours, its = learned(crops[0]), own(crops[0])
    for field in ours._fields[:-1]:  # a guess has no shade
        assert torch.equal(getattr(ours, field), getattr(its, field)), field
    assert choose_prior("learned") is learned  # read once a process


def test_a_network_is_told_from_another_by_its_digest_where_its_notes_say_nothing(network, tmp_path):
    path = tmp_path / "network.safetensors"
    save_network(path, network, notes="trained by hand")
    assert choose_prior(path).about == {"name": str(path), "sha256": digest(path)}


def test_a_bundled_prior_that_is_missing_is_told(bundle, tmp_path):
    bundle(tmp_path / "nothing.safetensors")
    with pytest.raises(InputError, match=r"the learned prior is not installed; reinstall oasis-warp, or use --prior"):
        choose_prior("learned")


def test_a_file_that_is_no_network_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"none.safetensors: expected a network's weights, found no such file"):
        choose_prior(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("text")
    with pytest.raises(InputError, match="got another format or a file cut short"):
        choose_prior(tmp_path / "text.safetensors")


def test_a_network_of_another_hand_is_refused(weights, tmp_path, monkeypatch, hand):
    monkeypatch.setattr(home, "bundled_hand", lambda: replace(hand, name="other"))
    with pytest.raises(InputError, match="trained for the hand model 'bundled' .* but the one in use is 'other'"):
        choose_prior(weights)


def test_weights_of_a_backbone_that_nobody_reads_are_refused(weights, tmp_path):
    with pytest.raises(InputError, match=r"network.safetensors: does not use backbone weights"):
        choose_prior(weights, tmp_path / "model.safetensors")
    for word in ("learned", "none"):
        with pytest.raises(InputError, match=f"the prior '{word}': does not use backbone weights"):
            choose_prior(word, tmp_path / "model.safetensors")


def test_a_word_that_names_no_prior_is_an_error(as_shipped):
    with pytest.raises(ValueError, match="prior: expected 'learned', 'none' or a Path, got 'mean'"):
        choose_prior("mean")


def test_the_prior_that_ships_is_small_says_how_it_was_trained_and_knows_the_bundled_hand(hand, crops):
    bundled_prior.cache_clear()
    prior = choose_prior("learned")
    assert int(prior.about["step"]) > 0
    with resources.as_file(asset(*home.BUNDLED)) as path:
        assert path.stat().st_size <= 10_000_000
        assert json.loads(read_header(path)["notes"])["seed"] >= 0
    guess, mean = prior(crops[0]), MeanPrior(hand)(crops[0])
    assert all(bool(part.isfinite().all()) for part in guess if part is not None)
    assert not torch.equal(guess.colors[:100], mean.colors[:100])
