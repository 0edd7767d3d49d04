"""People: identities, the colour of skin, baked textures and their files."""

import pickle

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from oasis_warp.core.processes import worker_pool
from oasis_warp.ops import depth_map
from oasis_warp.synthetic import people
from oasis_warp.synthetic.atlas import HEIGHT, WIDTH, bundled_atlas
from oasis_warp.synthetic.body import bundled_body, device_name, skin_mesh
from oasis_warp.synthetic.identity import Population, sample_identity
from oasis_warp.synthetic.shots import EVERYBODY
from oasis_warp.synthetic.skin_lines import CORNER_WORDS, KINDS, LINE_WORDS, Palm, Strokes
from oasis_warp.synthetic.skin_plan import plan_person
from oasis_warp.synthetic.skin_texture import CHANNELS, bake_texture
from oasis_warp.synthetic.spectrum import _TO_RGB, ABOVE_MELANIN, Tint, _layers, skin_colors
from oasis_warp.synthetic.texels import draw_lines, texels_on

SEED = 13
KINDS_OF_PAINT = ("freckles", "hair", "polish", "tattoo", "ring", "plaster")
PAINTED, BARE = (Population(**dict.fromkeys(KINDS_OF_PAINT, share)) for share in (1.0, 0.0))


@pytest.fixture(scope="module")
def baked(hand):
    """Somebody with everything that is painted, and the same skin bare of it."""
    return [people._bake_person(SEED, 4, population, "cpu") for population in (PAINTED, BARE)]


def test_the_atlas_shows_what_a_depth_buffer_shows():
    body, atlas = bundled_body(), bundled_atlas()
    flat = torch.cat([body.uv * torch.tensor([WIDTH, HEIGHT]), torch.ones(len(body.uv), 1)], 1)
    seen = depth_map(flat, body.uv_faces, torch.eye(4), torch.eye(3), WIDTH, HEIGHT)
    shown = seen.face_ids >= 0
    assert torch.equal(body.faces[seen.face_ids[shown].long()], atlas.corners)
    torch.testing.assert_close(seen.barycentrics[shown], atlas.weights, atol=2e-7, rtol=0)
    assert torch.equal(atlas.fill[shown], torch.arange(len(atlas.points)))


def test_values_spread_from_vertices_to_texels(device):
    texels = texels_on(str(device))
    rest = bundled_body().rest.to(device)
    torch.testing.assert_close(texels.spread(rest.T.contiguous()).T, texels.points, atol=1e-4, rtol=0)


def test_the_coarse_mesh_is_the_one_that_its_tool_builds(hand):
    from build_coarse_meshes import coarse_mesh

    body, built = bundled_body(), coarse_mesh(skin_mesh(hand))
    np.testing.assert_array_equal(body.coarse_vertices, built["vertices"])
    np.testing.assert_array_equal(body.coarse_faces, built["faces"])


def test_a_line_is_drawn_where_it_was_added(device):
    grid = texels_on(str(device)).grid
    rows = bundled_atlas().snap(np.linspace([-60.0, 0, -8], [-30.0, 0, 6], 30), "palm")
    strokes = Strokes(np.random.default_rng(0))
    strokes.add("main", rows, 1.0, 0.8, taper=0.1, wobble=0.0)
    strokes.add("hair", rows[:1].repeat(3, 0), 1.0, 0.8)  # of no length: nothing
    drawn = draw_lines(strokes.lines(), grid)
    assert set(drawn) == set(KINDS) and not bool(drawn["hair"].any())
    far = torch.cdist(bundled_atlas().points.to(device), torch.from_numpy(rows).float().to(device)).amin(1)
    line = drawn["main"]
    assert 0.6 <= float(line.max()) <= 1.0 and float(line[far > 4].max()) == 0
    middle = torch.from_numpy(rows[10:20]).float().to(device)
    there = torch.cdist(middle, bundled_atlas().points.to(device)).argmin(1)
    assert float(line[there].min()) > 0.5


def test_where_no_line_was_added_none_is_drawn(device):
    lines = Strokes(np.random.default_rng(0)).lines()
    assert not any(bool(drawn.any()) for drawn in draw_lines(lines, texels_on(str(device)).grid).values())


def test_what_is_put_on_skin_shows_in_its_colour(baked):
    painted, bare = (p.texture[..., :3].float() for p in baked)
    assert 0.02 < float(((painted - bare).abs().amax(-1) > 0.02).float().mean()) < 0.6


def test_textures_are_finite_and_in_range(baked):
    for person in baked:
        texture = dict(zip(CHANNELS, person.texture.float().unbind(-1), strict=True))
        assert bool(person.texture.isfinite().all())
        for name in ("red", "green", "blue"):
            assert 0.002 < float(texture[name].min()) and float(texture[name].max()) < 0.91
        assert float(texture["fold"].max()) <= 0 and float(texture["wrinkle"].max()) <= 0
        assert float(texture["fold"].min()) < -0.1 and float(texture["height"].min()) < -0.2


def test_the_tone_is_the_mean_of_the_texture(baked):
    torch.testing.assert_close(baked[0].tone, baked[0].texture[..., :3].float().mean((0, 1)))


def test_a_plan_travels_and_is_painted_the_same_again(baked):
    sent = pickle.dumps(plan_person(SEED, 4, PAINTED))
    assert len(sent) < 2e6
    assert torch.equal(bake_texture(pickle.loads(sent), "cpu"), baked[0].texture)


@pytest.mark.slow
def test_processes_plan_the_same_skin():
    with worker_pool(1) as pool:
        plans = list(pool.map(plan_person, [SEED] * 3, [4, 5, 6], [PAINTED] * 3, chunksize=2))
    for number, there in zip([4, 5, 6], plans, strict=True):
        here = plan_person(SEED, number, PAINTED)
        np.testing.assert_array_equal(there.lines.numbers, here.lines.numbers)
        np.testing.assert_array_equal(there.spots, here.spots)
        assert there.identity.seed == here.identity.seed


@pytest.mark.gpu
def test_a_gpu_bakes_the_person_that_the_cpu_bakes(baked, monkeypatch):
    monkeypatch.setattr(people, "_cache", type(people._cache)())
    monkeypatch.setattr(people, "MAX_PLANNED_HERE", 0)
    people.bake_people(SEED, [4], PAINTED, "cuda", jobs=1)
    ((_, there),) = people._cache.items()
    assert people.person(SEED, 4, PAINTED, "cuda:0") is there
    here = baked[0]
    for name in ("rest", "joints", "tips", "ring"):
        torch.testing.assert_close(getattr(there, name).cpu(), getattr(here, name), atol=1e-6, rtol=0)
    torch.testing.assert_close(there.areas.cpu(), here.areas, atol=1e-10, rtol=1e-3)
    torch.testing.assert_close(there.tone.cpu(), here.tone, atol=1e-5, rtol=0)
    off = (there.texture.cpu().float() - here.texture.float()).abs()
    assert float(off.mean()) < 1e-5
    # A hole in a plaster or the end of a dab falls one way or the other.
    assert float((off > 4e-3).float().mean()) < 1e-5


@pytest.mark.gpu
def test_a_gpu_needs_no_kernel_for_the_cpu(monkeypatch):
    from oasis_warp.ops._runtime import launch

    people._cache.clear()
    was = launch.device_and_stream

    def refuse(tensor):
        assert tensor.is_cuda, "a kernel was launched on the CPU"
        return was(tensor)

    monkeypatch.setattr(launch, "device_and_stream", refuse)
    for cached in (bundled_atlas, bundled_body, texels_on):
        cached.cache_clear()
    people.person(SEED, 4, EVERYBODY, "cuda")


def test_lines_of_the_palm_lie_on_the_palm():
    atlas, rng = bundled_atlas(), np.random.default_rng(5)
    strokes = Strokes(rng)
    Palm(atlas, strokes, plan_person(SEED, 4, BARE).identity).draw()
    drawn = strokes.lines()
    rows = drawn.numbers[: drawn.n_lines * LINE_WORDS].reshape(-1, LINE_WORDS)
    corners = drawn.numbers[drawn.n_lines * LINE_WORDS :][: drawn.n_corners * CORNER_WORDS].reshape(-1, CORNER_WORDS)
    kind = np.repeat(rows[:, 6].astype(int), rows[:, 0].astype(int))
    texel = cKDTree(atlas.positions).query(corners[:, :3])[1]
    outward = atlas.normals.numpy()[texel, 1]  # of a hand at rest the palm faces -y
    assert (outward < 0).all(), {KINDS[k] for k in kind[outward >= 0]}


@pytest.fixture(autouse=True)
def nobody_known(monkeypatch):
    monkeypatch.setattr(people, "_cache", type(people._cache)())


@pytest.fixture(scope="module")
def folder(baked, tmp_path_factory):
    """A folder with person 4, written by `bake_people`."""
    made = tmp_path_factory.mktemp("people")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(people, "_cache", type(people._cache)())
        patch.setattr(people, "_bake_person", lambda *who: baked[0])
        people.bake_people(SEED, [4], PAINTED, "cpu", jobs=0, folder=made)
    return made


def test_a_person_that_was_written_is_read_and_not_baked(baked, folder, monkeypatch):
    written, reports = baked[0], []
    monkeypatch.setattr(people, "_bake_person", None)
    people.bake_people(SEED, [4], PAINTED, "cpu", jobs=0, folder=folder, progress=lambda *what: reports.append(what))
    read = people.person(SEED, 4, PAINTED, "cpu")
    assert reports == [("people", 0, 1), ("people", 1, 1)]
    assert read.ring_material == written.ring_material and read.identity.seed == written.identity.seed
    for name, value in written._asdict().items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == getattr(read, name).dtype and torch.equal(value, getattr(read, name)), name


def test_a_device_has_one_name(monkeypatch):
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    assert [device_name(d) for d in ("cpu", "cuda", "cuda:0", torch.device("cuda"))] == [
        "cpu", "cuda:1", "cuda:0", "cuda:1"
    ]  # fmt: skip


@pytest.mark.parametrize("damage", ["cut short", "another's"])
def test_a_file_that_is_damaged_or_of_somebody_else_is_made_again(folder, tmp_path, monkeypatch, damage):
    data = (folder / "000004.safetensors").read_bytes()
    number = 4 if damage == "cut short" else 5
    (tmp_path / f"{number:06d}.safetensors").write_bytes(data[:1000] if damage == "cut short" else data)
    calls = []
    person = people._read(folder / "000004.safetensors", SEED, 4, PAINTED)
    monkeypatch.setattr(people, "_bake_person", lambda *who: calls.append(who) or person)
    people.bake_people(SEED, [number], PAINTED, "cpu", jobs=0, folder=tmp_path)
    assert calls == [(SEED, number, PAINTED, "cpu")]


def skin_reflectance(melanin, blood, *, oxygen=0.7, epidermis=80.0, carotene=0.0):
    """Linear sRGB reflectance of skin, summed over all wavelengths."""
    crossed, dermis = _layers(melanin[:, None], blood[:, None], oxygen, epidermis, carotene)
    return ((ABOVE_MELANIN + (1 - ABOVE_MELANIN) * crossed * dermis) @ _TO_RGB.T).clip(0.002, 0.95)


def linear_to_lab(linear):
    return cv2.cvtColor(np.float32(linear)[None], cv2.COLOR_LRGB2Lab)[0]


def test_the_table_of_a_person_agrees_with_the_spectrum():
    rng = np.random.default_rng(0)
    melanin, blood = np.exp(rng.uniform(np.log(0.004), np.log(0.5), 200)), np.exp(rng.uniform(-5.5, -2.5, 200))
    how = {"oxygen": 0.75, "epidermis": 80.0, "carotene": 0.1}
    other = how | {"oxygen": 0.15}
    tints = [Tint(**how), Tint(**other)]
    first, second = skin_colors(torch.from_numpy(melanin).float(), torch.from_numpy(blood).float(), tints)
    np.testing.assert_allclose(first.T, skin_reflectance(melanin, blood, **how), atol=3e-3)
    np.testing.assert_allclose(second.T, skin_reflectance(melanin, blood, **other), atol=3e-3)


def test_melanin_darkens_and_blood_reddens():
    melanin = np.geomspace(0.005, 0.4, 12)
    lab = linear_to_lab(skin_reflectance(melanin, np.full(12, 0.0125)))
    assert (np.diff(lab[:, 0]) < 0).all()
    pale, flushed = linear_to_lab(skin_reflectance(np.array([0.02, 0.02]), np.array([0.006, 0.04])))
    assert flushed[1] > pale[1] + 5


def test_bare_light_skin_is_where_measured_skin_is():
    lab = linear_to_lab(skin_reflectance(np.array([0.01]), np.array([0.012])))[0]
    assert 64 < lab[0] < 73 and 6 < lab[1] < 13 and 10 < lab[2] < 20


def test_identities_are_a_function_of_seed_and_number():
    hand = bundled_body().hand
    a, b = (sample_identity(hand, 5, 9, Population()) for _ in range(2))
    np.testing.assert_array_equal(a.shape, b.shape)
    assert a[1:] == b[1:]
    assert sample_identity(hand, 5, 10, Population()).melanin != a.melanin
    assert sample_identity(hand, 6, 9, Population()).melanin != a.melanin


@pytest.mark.parametrize("kind", ["freckles", "hair", "polish", "tattoo", "ring", "plaster"])
def test_a_kind_that_the_population_lacks_never_occurs_and_changes_nothing_else(kind):
    hand = bundled_body().hand
    shown = {"freckles": "freckles", "hair": "hairs", "polish": "polish", "tattoo": "tattoo", "ring": "ring_finger",
             "plaster": "plaster"}[kind]  # fmt: skip
    absent = {"ring": -1, "polish": None}.get(kind, 0)
    for number in range(20):
        with_it = sample_identity(hand, 0, number, Population(**{kind: 1.0}))
        without = sample_identity(hand, 0, number, Population(**{kind: 0.0}))
        assert getattr(without, shown) == absent
        same = with_it._replace(**{shown: absent}, shape=None), without._replace(shape=None)
        assert same[0] == same[1]


def test_identities_cover_the_range_of_human_skin():
    hand = bundled_body().hand
    melanin = np.array([sample_identity(hand, 0, n, Population()).melanin for n in range(300)])
    lab = linear_to_lab(skin_reflectance(melanin, np.full(300, 0.0135)))
    assert lab[:, 0].max() > 66 and lab[:, 0].min() < 33
