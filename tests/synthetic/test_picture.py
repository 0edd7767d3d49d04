import cv2
import numpy as np
import pytest
import torch

from oasis_warp.core.camera import project
from oasis_warp.core.mirror import mirror_points, mirror_pose
from oasis_warp.core.types import Camera, HandPose
from oasis_warp.hand.skinning import hand21, rest_hand, skin
from oasis_warp.ops import depth_map
from oasis_warp.pretraining.training_batch import LabelledPictures, training_batch
from oasis_warp.synthetic import people
from oasis_warp.synthetic.body import bundled_body
from oasis_warp.synthetic.picture import render_batch, stream
from oasis_warp.synthetic.sensor import expose, jpeg, sample_sensor, sensor_row, srgb
from oasis_warp.synthetic.shots import (
    EVERYBODY,
    PHOTOS,
    PICTURES_EACH,
    SceneConfig,
    concatenate_tables,
    sample_shot,
    sample_table,
    sample_tables_ahead,
)

SIZE = 64
SEED = 13
INDICES = (0, 1, 2, 3, PICTURES_EACH, PICTURES_EACH + 1)


@pytest.fixture(scope="module")
def batch(hand):
    """Photos of two people of world 13: one shows a left hand, the other a right one."""
    return render_batch(SEED, INDICES, SIZE)


def _grown(mask):
    """A mask and its neighbours."""
    return torch.nn.functional.max_pool2d(mask[None].float(), 3, 1, 1)[0] > 0


def _same(a, b, share=0.999, tolerance=1e-4):
    return float(((a - b).abs() <= tolerance).float().mean()) >= share


def test_the_two_people_of_these_tests_show_both_sides(batch):
    assert set(batch.left.tolist()) == {0, 1}
    assert set(batch.person.tolist()) == {0, 1}


def test_a_picture_depends_on_seed_and_index_alone(batch):
    again = render_batch(SEED, [INDICES[4], INDICES[1]], SIZE)
    for name in ("alpha", "mask", "landmarks", "angles", "translation", "K", "shape"):
        torch.testing.assert_close(getattr(again, name), getattr(batch, name)[[4, 1]], atol=1e-5, rtol=1e-5)
    assert _same(again.image, batch.image[[4, 1]], share=0.98)  # a rounded JPEG coefficient may flip
    assert again.gestures == (batch.gestures[4], batch.gestures[1])


def test_other_seeds_and_indices_give_other_pictures(batch):
    shots = [sample_shot(SEED, k) for k in range(8)] + [sample_shot(SEED + 1, 0)]
    assert len({shot.seed for shot in shots}) == 9
    assert not _same(batch.image[0], batch.image[1], share=0.5)


def test_pictures_are_finite_and_in_range(batch):
    for name in ("image", "alpha", "mask"):
        values = getattr(batch, name)
        assert float(values.min()) >= 0 and float(values.max()) <= 1 and bool(values.isfinite().all())
    assert not bool(batch.depth.isnan().any())
    for name in ("landmarks", "landmarks_3d", "angles", "orientation", "translation", "shape", "K"):
        assert bool(getattr(batch, name).isfinite().all())


def test_the_mask_is_a_part_of_what_stands_before_the_room(batch):
    assert bool((batch.mask <= batch.alpha + 1e-6).all())
    assert bool((batch.depth.isfinite() == (batch.alpha > 0)).all())
    share = batch.mask.mean((1, 2))
    assert float(share.min()) > 0.03 and float(share.max()) < 0.7


def test_pose_shape_and_camera_explain_mask_depth_and_landmarks(batch, hand):
    for k in range(len(INDICES)):
        left = bool(batch.left[k])
        pose = HandPose(batch.angles[k], batch.orientation[k], batch.translation[k])
        posed = skin(hand, rest_hand(hand, batch.shape[k]), mirror_pose(pose) if left else pose)
        points, marks = posed.vertices, hand21(posed, hand)
        if left:  # a left hand is the mirrored model: here the right one was posed in the mirror
            points, marks = mirror_points(points), mirror_points(marks)
        camera = Camera(torch.eye(4), batch.K[k], SIZE, SIZE)
        torch.testing.assert_close(marks, batch.landmarks_3d[k], atol=2e-5, rtol=0)
        torch.testing.assert_close(project(camera, marks)[0], batch.landmarks[k], atol=0.02, rtol=0)
        seen = depth_map(points, hand.faces, camera.viewmat, camera.K, SIZE, SIZE)
        inside, shown = seen.face_ids >= 0, batch.mask[k] > 0.5
        # Relief, of up to 3 mm, is not the model's; arm and clothes may stand before the hand.
        assert float((shown & ~_grown(inside)).sum()) <= 0.02 * float(shown.sum())
        assert float((inside & ~_grown(batch.alpha[k] > 0.5)).sum()) <= 0.02 * float(inside.sum())
        assert float((inside & shown).sum()) > 0.7 * float(inside.sum())
        both = inside & (batch.mask[k] > 0.99)
        off = (seen.depth[both] - batch.depth[k][both]).abs()
        assert float(off.median()) < 0.003


def test_landmarks_lie_on_the_hand_unless_clothes_cover_them(batch):
    u, v = batch.landmarks.long().clamp(0, SIZE - 1).unbind(-1)
    each = torch.arange(len(INDICES))[:, None]
    assert float((batch.alpha[each, v, u] > 0).float().mean()) > 0.95


def test_angles_respect_the_joint_limits(batch):
    low, high = bundled_body().hand.pose_limits[1:].unbind(-1)
    assert bool((batch.angles >= low - 1e-5).all()) and bool((batch.angles <= high + 1e-5).all())


def test_even_looks_show_the_same_person_on_black_without_clothes(batch):
    even = render_batch(SEED, INDICES[:2], SIZE, scene=SceneConfig(look="even"))
    torch.testing.assert_close(even.shape, batch.shape[:2])
    assert float(even.image[even.alpha == 0].abs().max()) == 0
    lit = even.image[even.mask > 0.99]
    assert 0.05 < float(lit.mean()) < 0.95
    assert bool((even.left == batch.left[:2]).all())


def test_photos_and_even_looks_make_a_training_batch(batch, hand):
    photos = render_batch(SEED, [0, PICTURES_EACH], SIZE)
    indices = [1, 2, PICTURES_EACH + 1, PICTURES_EACH + 2]
    targets = render_batch(SEED, indices, SIZE, scene=SceneConfig(look="even"))
    assert isinstance(photos, LabelledPictures)
    made = training_batch(hand, photos, targets, SIZE, torch.Generator().manual_seed(0))
    assert made.target_images.shape == (2, 2, SIZE, SIZE, 3)
    # The surface of the truth, drawn by the truth's camera, is where the true picture shows the hand.
    seen = depth_map(
        made.target_posed.flatten(0, 1), hand.faces, made.target_viewmats.flatten(0, 1), made.target_Ks.flatten(0, 1),
        SIZE, SIZE,
    )  # fmt: skip
    shown, inside = made.target_masks.flatten(0, 1) > 0.5, seen.face_ids >= 0
    assert float((shown & inside).sum() / shown.sum()) > 0.93


def test_the_hand_is_shown_as_large_as_it_was_drawn(batch):
    for k, index in enumerate(INDICES):
        rows, columns = torch.nonzero(batch.mask[k] > 0.5).unbind(1)
        longer = max(int(rows.max() - rows.min()), int(columns.max() - columns.min())) + 1
        wanted = sample_shot(SEED, index).view.fill * SIZE
        assert longer < 1.15 * wanted + 2  # a sleeve may cover some, the border may cut some off


def test_a_stream_gives_the_batches_that_render_batch_gives(batch):
    first = next(stream(SEED, 2, SIZE))
    torch.testing.assert_close(first.landmarks, batch.landmarks[:2], atol=1e-4, rtol=0)
    assert first.index.tolist() == [0, 1]


@pytest.mark.gpu
def test_a_gpu_shows_what_the_cpu_shows(batch):
    there = render_batch(SEED, INDICES, SIZE, "cuda")
    for name in ("alpha", "mask"):
        assert _same(getattr(there, name).cpu(), getattr(batch, name), tolerance=1e-3)
    torch.testing.assert_close(there.landmarks.cpu(), batch.landmarks, atol=1e-2, rtol=0)
    assert _same(there.image.cpu(), batch.image, share=0.95, tolerance=0.02)


def test_lights_and_views_are_finite_over_many_seeds():
    for index in range(60):
        shot = sample_shot(3, index, SceneConfig(look="even" if index % 2 else "photo"))
        assert np.isfinite(shot.light.sky).all()
        assert (shot.room is None) == (shot.sensor is None) == bool(index % 2)
        assert shot.room is None or np.isfinite(shot.room.solids).all()
        np.testing.assert_allclose(shot.view.rotation @ shot.view.rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(shot.view.rotation) > 0


def test_people_come_again_where_there_are_few():
    few = [sample_shot(0, k * PICTURES_EACH, SceneConfig(people=3)).person for k in range(7)]
    assert few == [0, 1, 2, 0, 1, 2, 0]


def test_processes_that_plan_ahead_plan_the_same():
    blocks = [(range(k, k + 2), PHOTOS) for k in (0, 2, 4)]
    together = sample_table(SEED, range(6), PHOTOS)
    ahead = concatenate_tables(list(sample_tables_ahead(SEED, blocks, workers=1)))
    assert ahead.gestures == together.gestures
    np.testing.assert_array_equal(ahead.whole, together.whole)
    np.testing.assert_array_equal(ahead.numbers, together.numbers)


@pytest.mark.slow
def test_people_baked_by_other_processes_are_the_same(monkeypatch):
    here = people.person(SEED, 0, EVERYBODY, "cpu")
    monkeypatch.setattr(people, "_cache", people.OrderedDict())
    people.bake_people(SEED, [0], EVERYBODY, "cpu", jobs=1)
    ((_, there),) = people._cache.items()
    for name in ("texture", "rest", "areas", "ring"):
        assert torch.equal(getattr(there, name), getattr(here, name))


def test_too_many_people_are_refused():
    with pytest.raises(ValueError, match="at most 48 people"):
        people.bake_people(SEED, range(49), EVERYBODY, "cpu", jobs=1)


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
