import cv2
import numpy as np
import torch

from oasis_warp.synthetic.sensor import expose, jpeg, sample_sensor, sensor_row, srgb


def _photo(size=48):
    rng = np.random.default_rng(0)
    small = rng.random((6, 6, 3)).astype(np.float32)
    return torch.from_numpy(cv2.resize(small, (size, size), interpolation=cv2.INTER_CUBIC).clip(0, 1))


def _rows(*sensors):
    return torch.tensor([sensor_row(sensor) for sensor in sensors])


def test_our_jpeg_loses_what_a_real_one_loses():
    image = _photo()
    for quality in (60, 80, 95):
        ours = jpeg(image.permute(2, 0, 1)[None], torch.tensor([float(quality)]))[0].permute(1, 2, 0).numpy()
        pixels = (image.numpy() * 255).round().astype(np.uint8)
        flags = [
            cv2.IMWRITE_JPEG_QUALITY,
            quality,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
        ]
        _, file = cv2.imencode(".jpg", pixels[..., ::-1], flags)
        real = np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR))[..., ::-1] / 255
        lost = np.abs(real - image.numpy()).mean()
        assert np.abs(ours - real).mean() < 0.4 * lost + 1.5 / 255


def test_jpeg_keeps_sizes_that_are_no_multiple_of_its_blocks():
    image = _photo(45).permute(2, 0, 1)[None]
    out = jpeg(image, torch.tensor([90.0]))
    assert out.shape == image.shape
    assert (out - image).abs().mean() < 0.02


def test_more_light_gives_a_brighter_photo_of_the_same_scene():
    sensor = sample_sensor(np.random.default_rng(1))
    scene = _photo()[None] * 0.5
    alpha, incident, seeds = torch.ones(1, 48, 48), torch.ones(1, 3), torch.tensor([1], dtype=torch.int32)
    means = [
        float(expose(scene, alpha, _rows(sensor._replace(exposure=e)), incident, seeds).mean()) for e in (0.1, 0.2, 0.4)
    ]
    assert means[0] < means[1] < means[2]


def test_photos_are_in_range_and_do_not_depend_on_their_batch():
    rng = np.random.default_rng(2)
    sensors = [sample_sensor(rng) for _ in range(3)]
    scenes = torch.stack([_photo() * k for k in (0.05, 1.0, 8.0)])
    alpha, incident = torch.ones(3, 48, 48) * 0.5, torch.tensor([[1.0, 0.8, 0.6]]).expand(3, 3)
    seeds = torch.tensor([5, 6, 7], dtype=torch.int32)
    together = expose(scenes, alpha, _rows(*sensors), incident, seeds)
    assert float(together.min()) >= 0 and float(together.max()) <= 1
    for k in range(3):
        alone = expose(scenes[k : k + 1], alpha[k : k + 1], _rows(sensors[k]), incident[k : k + 1], seeds[k : k + 1])
        assert ((alone[0] - together[k]).abs() < 1e-5).float().mean() > 0.98  # a rounded JPEG coefficient may flip


def test_srgb_ends_and_middle():
    np.testing.assert_allclose(srgb(torch.tensor([0.0, 0.2140, 1.0])), [0, 0.5, 1], atol=1e-3)
