import pytest
import torch
from synthetic import PALM_TO_CAMERA

from oasis_warp.core.types import Camera, Gaussians, HandPose
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin_surface
from oasis_warp.ops import rasterization
from oasis_warp.ops.cuda_graph import MAX_GRAPHS, CapturedGraph, GraphCache, replayable, replayed
from oasis_warp.render import render

COLOR = (0.25, 0.5, 1.0)


@pytest.fixture
def scene(device):
    g = torch.Generator().manual_seed(0)
    viewmat, K = torch.eye(4), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
    viewmat[2, 3] = 2
    gaussians = Gaussians(
        torch.randn(5, 3, generator=g) * 0.3,
        torch.randn(5, 4, generator=g),
        torch.rand(5, 3, generator=g) * 0.2 + 0.05,
        torch.rand(5, generator=g) * 0.8 + 0.1,
        torch.rand(5, 3, generator=g),
    )
    return Gaussians(*(t.to(device) for t in gaussians)), Camera(viewmat.to(device), K.to(device), 17, 15)


@pytest.mark.parametrize("kind", [tuple, torch.tensor])
def test_it_is_the_rasterizer_over_a_plain_background(scene, kind):
    gaussians, camera = scene
    behind = torch.tensor([COLOR], device=camera.K.device)
    images, alphas, _ = rasterization(*gaussians, camera.viewmat[None], camera.K[None], 17, 15, backgrounds=behind)
    for _ in range(2):
        drawn = render(gaussians, camera, background=kind(COLOR))
        assert torch.equal(drawn.image, images[0]) and torch.equal(drawn.alpha, alphas[0, ..., 0])


def test_the_camera_may_be_of_another_type_than_the_gaussians(scene):
    gaussians, camera = scene
    wide = Camera(camera.viewmat.double(), camera.K.double(), 17, 15)
    assert torch.equal(render(gaussians, wide).image, render(gaussians, camera).image)


def test_a_background_that_is_a_tensor_gets_its_gradient(scene):
    gaussians, camera = scene
    background = torch.tensor(COLOR, device=camera.K.device, requires_grad=True)
    drawn = render(gaussians, camera, background=background)
    (gradient,) = torch.autograd.grad(drawn.image.sum(), background)
    assert torch.allclose(gradient, (1 - drawn.alpha).sum().expand(3), rtol=1e-5)


class Log:
    """Stands for recordings: says which one was made and used; `full` ones overflow."""

    def __init__(self):
        self.made, self.used, self.full = [], [], set()

    def run(self, recordings, key, value=1.0):
        def record():
            self.made.append(key)
            return lambda inputs: self.use(key, inputs)

        inputs = [torch.tensor([value])]
        return replayed(recordings, key, record, lambda x: (x, torch.tensor([-1.0])), inputs)

    def use(self, key, inputs):
        self.used.append(key)
        return None if key in self.full else (inputs[0], torch.tensor([1.0]))


def test_a_recording_is_made_once_for_each_key_and_used_for_every_call():
    log, recordings = Log(), GraphCache()
    for key in ("a", "b", "a", "a", "b"):
        assert log.run(recordings, key, 3.0) == (torch.tensor([3.0]), torch.tensor([1.0]))
    assert log.made == ["a", "b"] and log.used == ["a", "b", "a", "a", "b"]


def test_the_recording_unused_for_longest_makes_room():
    log, recordings = Log(), GraphCache()
    for key in (*range(MAX_GRAPHS), 0, MAX_GRAPHS, 0, 1):
        log.run(recordings, key)
    assert log.made == [*range(MAX_GRAPHS), MAX_GRAPHS, 1]


def test_where_memory_did_not_suffice_the_exact_result_comes_and_the_next_call_records_anew():
    log, recordings = Log(), GraphCache()
    log.full.add("a")
    assert log.run(recordings, "a") == (torch.tensor([1.0]), torch.tensor([-1.0]))
    log.full.clear()
    assert log.run(recordings, "a") == (torch.tensor([1.0]), torch.tensor([1.0]))
    assert log.run(recordings, "a") == (torch.tensor([1.0]), torch.tensor([1.0]))
    assert log.made == ["a", "a"]


def test_a_function_that_cannot_be_recorded_leaves_nothing_behind():
    log, recordings = Log(), GraphCache()

    def fails():
        raise RuntimeError("no memory")

    with pytest.raises(RuntimeError, match="no memory"):
        replayed(recordings, "a", fails, lambda: (), [])
    log.run(recordings, "a")
    assert log.made == ["a"]


def test_nothing_is_replayed_on_the_cpu():
    assert not replayable(torch.device("cpu"), [torch.zeros(3)])


@pytest.mark.gpu
def test_only_calls_without_a_gradient_are_replayed():
    device = torch.device("cuda")
    plain, leaf = torch.zeros(3), torch.zeros(3, requires_grad=True)
    assert replayable(device, [plain, plain.cuda()])
    assert not replayable(device, [plain, leaf])
    with torch.no_grad():
        assert replayable(device, [plain, leaf])


def outputs_of(recording, inputs):
    outputs = recording(inputs)
    assert outputs is not None
    return outputs


def squared(matrix, vector):
    return matrix @ vector, vector.square()


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("places", ["cpu cpu", "cpu cuda", "cuda cuda"])
def test_a_recording_repeats_its_function_for_inputs_from_anywhere(places, dtype):
    like = torch.empty(0, dtype=dtype, device="cuda")
    generator, shapes = torch.Generator().manual_seed(0), [(4, 3), (3,)]
    calls = [
        [torch.randn(*shape, generator=generator).to(p) for shape, p in zip(shapes, places.split(), strict=True)]
        for _ in range(20)
    ]
    recording = CapturedGraph(squared, calls[0], like)
    found = [outputs_of(recording, inputs) for inputs in calls]  # none may touch another's memory
    for inputs, outputs in zip(calls, found, strict=True):
        wanted = squared(*(tensor.to(like) for tensor in inputs))
        for got, want in zip(outputs, wanted, strict=True):
            assert got.dtype == dtype and got.is_cuda
            torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-6)


@pytest.mark.gpu
def test_calls_on_different_streams_do_not_mix():
    like = torch.empty(0, device="cuda")
    recording = CapturedGraph(lambda x: (x * 2,), [torch.zeros(1000)], like)
    found, streams = [], [torch.cuda.Stream() for _ in range(3)]
    for k in range(30):
        with torch.cuda.stream(streams[k % 3]):
            found.append(outputs_of(recording, [torch.full((1000,), float(k))])[0])
    torch.cuda.synchronize()
    assert all((out == 2 * k).all() for k, out in enumerate(found))


@pytest.mark.gpu
def test_a_recording_says_when_its_memory_did_not_suffice():
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(2000, 3, generator=generator).cuda()
    ones = torch.ones(2000, device="cuda")
    quats, colors = torch.eye(4)[:1].repeat(2000, 1).cuda(), torch.rand(2000, 3, generator=generator).cuda()
    K = torch.tensor([[[200.0, 0, 128], [0, 200, 128], [0, 0, 1]]]).cuda()

    def picture(size, distance):
        viewmat = torch.eye(4, device="cuda")[None]
        viewmat = torch.cat([viewmat[..., :3], viewmat[..., 3:] + distance * viewmat[..., 2:3]], -1)
        scales = size * ones[:, None].expand(-1, 3)
        image, _, _ = rasterization(means, quats, scales, 0.1 * ones, colors, viewmat, K, 256, 256, validate=False)
        return (image,)

    small, large = ([torch.tensor([size]), torch.tensor([6.0])] for size in (0.01, 0.5))
    recording = CapturedGraph(picture, small, means)
    assert torch.equal(outputs_of(recording, small)[0], picture(*(part.cuda() for part in small))[0])
    assert recording(large) is None
    assert torch.equal(outputs_of(recording, small)[0], picture(*(part.cuda() for part in small))[0])
    again = CapturedGraph(picture, large, means)
    assert torch.equal(outputs_of(again, large)[0], picture(*(part.cuda() for part in large))[0])


@pytest.mark.gpu
def test_a_replayed_hand_follows_its_pose(hand):
    model = hand.to("cuda")
    rest = rest_hand(model, torch.zeros(len(hand.shape_names), device="cuda"))

    def surface(*pose):
        return (skin_surface(model, rest, HandPose(*pose)),)

    poses = [
        HandPose(named_pose(hand, name), PALM_TO_CAMERA, torch.tensor([0.0, 0.1, 0.5]))
        for name in ("open", "fist", "pinch")
    ]
    recording = CapturedGraph(surface, poses[0], rest.vertices)
    for pose in poses:
        assert torch.equal(outputs_of(recording, pose)[0], surface(*(part.cuda() for part in pose))[0])
