"""Image encoders, our own and DINOv2 from a file, and the tokens read off their features."""

import pytest
import torch
from disk import trust
from safetensors.torch import save_file
from torch.nn.functional import grid_sample
from torch.utils._python_dispatch import TorchDispatchMode

from oasis_warp.avatar.observation import batch_of_crop, observe_batch, project_batch, sample
from oasis_warp.core.camera import project
from oasis_warp.core.errors import InputError
from oasis_warp.core.types import Camera
from oasis_warp.losses import Lpips
from oasis_warp.network.encoders import SIZES, ConvolutionalEncoder, DinoV2Encoder, ImageFeatures, Size
from oasis_warp.network.tokens import Aggregation, PointFeatures, PositionEncoding, Tokenizer, encode, grid_positions


def literal_aggregation(planes, uv, sigma, reach):
    """Equation 2 sample by sample; `covered` is the share of a sample's footprint that lies on the map."""
    _, _, height, width = planes.shape
    total, count = 0, 0
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            shifted = uv + torch.tensor([j / width, i / height])
            weight = torch.exp(-torch.tensor(float(i * i + j * j)).sqrt() / sigma)
            grid = (2 * shifted - 1)[:, None]
            covered = grid_sample(torch.ones_like(planes[:, :1]), grid, align_corners=False)
            total = total + weight * grid_sample(planes, grid, align_corners=False)
            count = count + weight * covered
    return (total / count)[:, :, 0].transpose(1, 2)


@pytest.mark.parametrize("neighborhood", [1, 3, 5])
def test_one_sample_of_a_convolved_map_is_the_weighted_sum_of_samples(neighborhood, random):
    planes, uv = torch.randn(2, 3, 9, 12, generator=random), torch.rand(2, 40, 2, generator=random)
    uv[0, :4] = torch.tensor([[0.0, 0.0], [1.0, 1.0], [0.01, 0.5], [0.5, 0.99]])  # on and near the border
    aggregate = Aggregation(neighborhood)
    with torch.no_grad():
        aggregate.log_sigma.fill_(0.4)
    expected = literal_aggregation(planes, uv, aggregate.log_sigma.exp().detach(), neighborhood // 2)
    torch.testing.assert_close(aggregate(planes, uv), expected, atol=2e-6, rtol=1e-5)


def test_samples_beyond_the_border_do_not_darken_what_lies_at_it(random):
    uv = torch.cat([torch.rand(1, 30, 2, generator=random), torch.tensor([[[0.0, 0.0], [1.0, 0.3]]])], dim=1)
    flat = Aggregation(5)(torch.full((1, 2, 8, 8), 0.7), uv)
    torch.testing.assert_close(flat, torch.full_like(flat, 0.7))


def test_aggregation_learns_how_far_to_look(random):
    aggregate = Aggregation(5)
    planes, uv = torch.randn(1, 3, 9, 9, generator=random), torch.rand(1, 20, 2, generator=random)
    (gradient,) = torch.autograd.grad(aggregate(planes, uv).square().sum(), aggregate.log_sigma)
    log_sigma = torch.zeros((), requires_grad=True)
    literal = literal_aggregation(planes, uv, log_sigma.exp(), 2)
    (expected,) = torch.autograd.grad(literal.square().sum(), log_sigma)
    torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-6)
    narrow, wide = Aggregation(5), Aggregation(5)
    with torch.no_grad():
        narrow.log_sigma.fill_(-3)
        wide.log_sigma.fill_(2)
        single, mean = narrow(planes, uv), wide(planes, uv)
    torch.testing.assert_close(single, sample(planes, uv) / sample(torch.ones_like(planes), uv))
    assert float(mean.var(1).sum()) < float(single.var(1).sum())


def test_a_pixel_is_read_at_its_own_centre():
    planes = torch.zeros(1, 1, 8, 8)
    planes[0, 0, 2, 5] = 1
    uv = (torch.tensor([[[5.5, 2.5], [5.0, 2.5], [4.5, 2.5], [5.5, 3.5]]]) / 8).float()
    torch.testing.assert_close(sample(planes, uv)[0, :, 0], torch.tensor([1.0, 0.5, 0.0, 0.0]))


def test_points_project_as_the_camera_says(crops):
    crop = crops[0]
    inputs = batch_of_crop(crop)
    uv, inside = project_batch(inputs.posed, inputs.viewmat, inputs.K, 64)
    camera = Camera(crop.camera.viewmat, crop.camera.K, 64, 64)
    expected, _ = project(camera, crop.posed.vertices)
    torch.testing.assert_close(uv[0] * 64, expected, atol=1e-4, rtol=0)
    assert bool(inside.all())


def test_a_point_behind_the_camera_or_off_the_frame_is_not_inside():
    K = torch.tensor([[[50.0, 0, 32], [0, 50, 32], [0, 0, 1]]])
    points = torch.tensor([[[0.0, 0, 1], [0, 0, -1], [0, 0, 0], [1, 0, 1], [0, -1, 1]]])
    uv, inside = project_batch(points, torch.eye(4)[None], K, 64)
    assert inside[0].tolist() == [True, False, False, False, False]
    assert bool(uv.isfinite().all())


def test_what_lies_outside_the_frame_gets_no_feature(random):
    features = ImageFeatures(torch.randn(1, 6, 8, 8, generator=random), torch.zeros(1, 1, 1, 1), None)
    uv, inside = torch.rand(1, 10, 2, generator=random), torch.arange(10)[None] < 6
    read = PointFeatures(6, 0, 16, 5)(features, uv, inside)
    assert not read[:, 6:].any()
    assert bool(read[:, :6].any(-1).all())


def test_a_coloured_dot_speaks_to_the_points_that_project_onto_it(network, crops):
    inputs = batch_of_crop(crops[0])
    observation = observe_batch(inputs, network.faces, network.vertex_faces, network.vertex_index)
    target = int(observation.confidence[0].argmax())
    place = (observation.uv[0, target] * 64).long()
    dotted = inputs.image.clone()
    dotted[0, place[1], place[0]] = torch.tensor([0.0, 1.0, 0.0])
    with torch.no_grad():
        plain = network.point_features(network.encoder(inputs.image, inputs.mask), observation.uv, observation.inside)
        changed = network.point_features(network.encoder(dotted, inputs.mask), observation.uv, observation.inside)
    change = (changed - plain).norm(dim=-1)[0]
    distance = (observation.uv[0] * 64 - (place + 0.5)).norm(dim=-1)
    near, far = change[distance < 0.5], change[distance > 12]
    assert len(near) and len(far)
    assert float(near.min()) > 5 * float(far.max())
    assert float(distance[change.argmax()]) < 1


@pytest.fixture(params=[False, True], ids=["learned", "literal"])
def tokenizer(request):
    torch.manual_seed(0)
    return Tokenizer(16, 2, 7, literal=request.param)


@pytest.fixture
def points(random):
    features = torch.randn(2, 30, 16, generator=random)
    offsets = torch.randn(2, 30, 16, generator=random)
    return features, offsets, torch.rand(2, 30, 2, generator=random), torch.rand(2, 30, generator=random) < 0.7


def test_the_order_of_points_does_not_matter(tokenizer, points, random):
    order = torch.randperm(30, generator=random)
    plain, shuffled = tokenizer(*points), tokenizer(*(part[:, order] for part in points))
    torch.testing.assert_close(plain.tokens, shuffled.tokens, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(plain.centers, shuffled.centers, atol=1e-6, rtol=1e-5)


def test_points_outside_the_frame_are_not_read(tokenizer, points):
    features, offsets, uv, inside = points
    plain = tokenizer(*points)
    out = ~inside[..., None]
    moved = tokenizer(features + 100 * out, offsets - 100 * out, uv + 5 * out, inside)
    assert torch.equal(plain.tokens, moved.tokens)
    assert torch.equal(plain.centers, moved.centers)


def test_tokens_lie_among_the_points_they_read(tokenizer, points):
    centers = tokenizer(*points).centers.detach()
    assert centers.shape == (2, 7, 2)
    assert 0 < float(centers.min()) and float(centers.max()) < 1


def test_the_literal_form_is_the_printed_one(points):
    torch.manual_seed(0)
    tokenizer = Tokenizer(16, 2, 7, literal=True)
    for last in (tokenizer.attention.output, tokenizer.feed_forward[-1]):  # leave the cross-attention alone
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.zeros_(last.bias)
    features, _, uv, _ = points
    everywhere = torch.ones(2, 30, dtype=torch.bool)
    tokens, centers = tokenizer(features, None, uv, everywhere)
    weights = (tokenizer.queries @ features.transpose(1, 2) / 4).softmax(-1)
    torch.testing.assert_close(tokens, weights @ features, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(centers, weights @ uv, atol=1e-5, rtol=1e-4)


def test_every_weight_learns(tokenizer, points):
    tokens, centers = tokenizer(*points)
    (tokens.square().sum() + centers.square().sum()).backward()
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in tokenizer.parameters())
    assert tokenizer.queries.grad.any(dim=-1).all()


def test_an_encoding_holds_sines_and_cosines_of_every_octave():
    x = torch.tensor([[0.25, -0.5]])
    expected = [torch.sin(torch.pi * 2**k * x[0, d]) for d in range(2) for k in range(3)]
    expected += [torch.cos(torch.pi * 2**k * x[0, d]) for d in range(2) for k in range(3)]
    torch.testing.assert_close(encode(x, 3)[0], torch.stack(expected), atol=1e-6, rtol=0)


def test_places_far_apart_are_encoded_differently_and_the_same_place_alike(random):
    place = PositionEncoding(32)
    uv = torch.rand(1, 50, 2, generator=random)
    torch.testing.assert_close(place(uv), place(uv.clone()))
    assert float(torch.pdist(place(uv)[0].detach()).min()) > 0.01


def test_cells_of_a_map_lie_at_their_centres():
    positions = grid_positions(2, 4, like=torch.zeros(1))
    torch.testing.assert_close(positions[0], torch.tensor([0.125, 0.25]))
    torch.testing.assert_close(positions[-1], torch.tensor([0.875, 0.75]))
    torch.testing.assert_close(positions[1] - positions[0], torch.tensor([0.25, 0.0]))


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
    trust(path)
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
    trust(text)
    with pytest.raises(InputError, match="expected the weights of DINOv2, got another format"):
        small_dino.load(text)
    other = tmp_path / "other.safetensors"
    weights = published(small_dino, "files")
    save_file({**weights, "embeddings.register_tokens": torch.zeros(1, 4, 32)}, other)
    trust(other)
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
