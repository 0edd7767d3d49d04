import functools
import math

import pytest
import torch
from synthetic import as_left_hand, avatar_of, crop_of

from oasis_warp.avatar import pose as posing
from oasis_warp.avatar import vertex_light as lit
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.pose import shading_factors, split_shade, with_photo_colors
from oasis_warp.avatar.sky import (
    IN_CREVICES,
    arriving_before,
    bounced,
    environment_light,
    harmonic_basis,
    in_crevices,
    sky_mesh,
    studio_light,
)
from oasis_warp.avatar.vertex_light import Lighting, posed_lighting, remaining_shade, rotate_light, view_shares
from oasis_warp.core import rotation
from oasis_warp.core.camera import camera_center
from oasis_warp.core.mirror import mirror_light, mirror_points
from oasis_warp.core.types import HandLight
from oasis_warp.data import avatar_file
from oasis_warp.hand.contact import resolve_contact
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import skin_surface
from oasis_warp.hand_avatar import Avatar
from oasis_warp.ops.corner_reading import read_corners

EVEN = HandLight(
    torch.tensor([[1.0] * 3, *[[0.0] * 3] * 3]), torch.tensor([[0.1] * 3, [2.0] * 3]), torch.ones(3),
    albedo=torch.tensor([0.5, 0.35, 0.3]),
)  # fmt: skip


@pytest.fixture(scope="module")
def scene(hand):
    """A fist in its photo."""
    return crop_of(hand, 0.8 * region_colors(label_regions(hand), 0.03), pose_name="fist", size=48)


def seen(hand, crop, posed):
    exposure = posed_lighting(crop.rest.vertices, posed, hand.faces, EVEN).exposure
    assert exposure is not None
    return exposure[:, 0]


def test_the_coarse_mesh_is_that_of_the_hand(hand):
    mesh = sky_mesh(torch.device("cpu"))
    assert int(mesh.vertices.max()) < len(hand.template) and int(mesh.faces.max()) < len(mesh.vertices)
    read = read_corners(hand.template[mesh.vertices], mesh.corners)
    assert float((read - hand.template).norm(dim=1).max()) < 0.003
    assert float(hand.weights[mesh.still, 0]) > 0.99


def test_a_fist_hides_the_palm_and_an_open_hand_does_not(hand, scene):
    crop, _, pose = scene
    avatar = avatar_of(hand, scene[1], pose, crop.camera, None)
    opened = avatar.mesh(pose._replace(angles=named_pose(hand, "open"))).vertices
    palm = (label_regions(hand).palm > 0.9) & (hand.segment == 0) & (hand.template[:, 0] < -0.05)
    in_fist, in_open = (seen(hand, crop, posed)[palm].median() for posed in (crop.posed.vertices, opened))
    assert float(in_fist) < 0.4 and float(in_open) > 0.85


def test_a_stiff_hand_sees_the_same_share_however_it_turns(hand, scene):
    crop, _, _ = scene
    turn = rotation.from_axis_angle(torch.tensor([0.6, 0.0, 0.8]), torch.tensor(1.9))
    before, after = (seen(hand, crop, posed) for posed in (crop.posed.vertices, crop.posed.vertices @ turn.T))
    off = (before - after).abs()
    assert float(off.quantile(0.99)) < 5e-4  # a step of rounding in a depth buffer, where hardly any light arrives
    assert float(off.max()) < 0.05  # beside an edge, rounding hides a vertex of the coarse mesh from one direction


def test_shade_goes_when_what_cast_it_has_moved(hand, scene):
    """An opened palm kept the shadows of the fingers of its fist: its own normals had not turned."""
    crop, truth, pose = scene
    facing = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, EVEN).normals
    shaded = EVEN._replace(shade=torch.full_like(facing, 0.4), facing=facing)
    plain, dark = (avatar_of(hand, truth, pose, crop.camera, light) for light in (EVEN, shaded))
    opened = pose._replace(angles=named_pose(hand, "open"))
    palm = (label_regions(hand).palm > 0.9) & (hand.segment == 0) & (hand.template[:, 0] < -0.05)
    palm = palm[truth.vertex_index].nonzero()[:, 0]
    ratios = [(dark.pose(p).colors / plain.pose(p).colors)[palm].median() for p in (pose, opened)]
    assert float(ratios[0]) == pytest.approx(0.4, abs=1e-3)
    assert float(ratios[1]) > 0.95


def test_deep_shade_ends_under_a_finger_that_opens_and_stays_under_the_others(hand, scene):
    """In the kernel that poses take: one finger leaves the hand's pose nearly as it was, so the sky alone decides."""
    crop, truth, pose = scene
    on = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, EVEN)
    shaded = EVEN._replace(shade=torch.full_like(on.normals, 0.4), facing=on.normals)
    plain, dark = (avatar_of(hand, truth, pose, crop.camera, light) for light in (EVEN, shaded))
    finger = [hand.joint_names.index(f"index{k}") - 1 for k in (1, 2, 3)]
    angles = pose.angles.clone()
    angles[finger] = named_pose(hand, "open")[finger]
    moved = pose._replace(angles=angles)
    surface = dark.mesh(moved).vertices
    facing = posed_lighting(crop.rest.vertices, surface, hand.faces, EVEN).normals
    more = (seen(hand, crop, surface) - seen(hand, crop, crop.posed.vertices))[truth.vertex_index]
    still = ((facing * on.normals).sum(1) > 0.999)[truth.vertex_index]
    left = (dark.pose(moved).colors / plain.pose(moved).colors)[: len(still), 1]
    assert int((still & (more > 0.26)).sum()) > 10
    assert float(left[still & (more > 0.26)].median()) > 0.95
    assert float(left[still & (more.abs() < 0.01)].median()) < 0.5


def test_deep_shade_beside_a_finger_that_lay_there_goes_with_it_and_weak_shade_stays(hand, scene):
    """Palms opened from a fist kept the gaps between its fingers, a pixel off, where the skin sees as much sky."""
    crop, truth, _ = scene
    on = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, EVEN)
    assert on.exposure is not None
    shared = on.exposure[:, 0]
    place = hand.template[(label_regions(hand).palm > 0.9) & (hand.segment == 0)].mean(0)
    away = (hand.template - place).norm(dim=1)
    was = torch.where(away < 0.003, shared - 0.5, shared)  # something lay there
    stays = remaining_shade(EVEN._replace(facing=on.normals), on, was)
    beside, far = (away > 0.006) & (away < 0.008), away > 0.03
    assert float(stays[beside, 0].max()) < 0.1 and float(stays[beside, 1].min()) == 1
    assert float(stays[far].min()) == 1
    covered = torch.where(away < 0.003, shared + 0.5, shared)  # now something lies there: a palm's lines stay in a fist
    assert float(remaining_shade(EVEN._replace(facing=on.normals), on, covered).min()) == 1
    dark, relief = (
        truth._replace(colors=torch.full_like(truth.colors, 0.5), shade=torch.full_like(truth.colors, factor))
        for factor in (0.4, 0.9)
    )
    light = EVEN._replace(facing=on.normals)
    left = [
        shading_factors(g, hand.faces, light, on, was) / shading_factors(g._replace(shade=None), hand.faces, light, on)
        for g in (dark, relief)
    ]
    at = beside[truth.vertex_index].nonzero()[:, 0]
    assert float(left[0][at].min()) > 0.9
    torch.testing.assert_close(left[1][at], torch.full_like(left[1][at], 0.9))


def test_deep_shade_ends_with_the_pose_of_the_photo_on_all_of_the_hand(hand):
    """A palm kept the light of the photo and the fingers, which turned, did not: two tones."""
    n_vertices = len(hand.template)
    facing = torch.tensor([[0.0, 0.0, 1.0]]).expand(n_vertices, 3)
    for share, left in ((0.0, 1.0), (0.3, 0.5), (0.6, 0.0)):
        normals = facing.clone()
        normals[: round(share * n_vertices)] = torch.tensor([1.0, 0.0, 0.0])
        stays = remaining_shade(EVEN._replace(facing=facing), Lighting(normals, None), None)
        assert float(stays[-1, 0]) == pytest.approx(left, abs=0.01) and float(stays[-1, 1]) == 1


def test_weak_shade_in_doubt_goes_when_the_sky_changes_nearby(hand):
    """A finger's print on the palm has the palm's colour, nearly; beside its outline the sky hardly changes."""
    n_vertices, sky = len(hand.template), sky_mesh(torch.device("cpu"))
    facing = torch.tensor([[0.0, 0.0, 1.0]]).expand(n_vertices, 3)
    seen, here = torch.ones(n_vertices), int(sky.vertices[500])
    beside = sky.vertices[sky.faces[sky.vertex_faces[500, 0]]]
    seen[beside[beside != here]] = 0.2
    on, light = Lighting(facing, torch.ones(n_vertices, 4)), EVEN._replace(facing=facing)
    for doubt, left in ((0.0, 1.0), (1.0, 0.0)):
        stays = remaining_shade(light._replace(doubt=torch.full((n_vertices,), doubt)), on, seen)
        assert float(stays[here, 0]) == 0 and float(stays[here, 1]) == left


def test_shade_in_doubt_goes_with_a_small_change_of_the_sky(hand):
    """The outline of a finger tip stayed on the palm when the finger was only half straightened."""
    n_vertices = len(hand.template)
    facing = torch.tensor([[0.0, 0.0, 1.0]]).expand(n_vertices, 3)
    on, light = Lighting(facing, torch.ones(n_vertices, 4)), EVEN._replace(facing=facing)
    for change, doubt, left in ((0.0, 1.0, 1.0), (0.08, 0.0, 1.0), (0.08, 1.0, 0.0)):
        in_doubt = light._replace(doubt=torch.full((n_vertices,), doubt))
        stays = remaining_shade(in_doubt, on, torch.full((n_vertices,), 1 - change))
        torch.testing.assert_close(stays, torch.full_like(stays, left), atol=1e-4, rtol=0)


def test_colours_and_shade_come_to_what_is_shown():
    shown = torch.tensor([[0.9, 0.5, 0.0], [1.0, 1.0, 0.2]])
    shade = torch.tensor([[0.5, 0.5, 0.5], [2.0, 0.5, 1.0]])
    colors, left = split_shade(shown, shade)
    assert float(colors.min()) > 0 and float(colors.max()) == 1 and float(left.min()) > 0
    torch.testing.assert_close(colors * left, shown, atol=2e-3, rtol=0)
    torch.testing.assert_close(left[1], torch.tensor([2.0, 1.0, 1.0]))


def test_a_light_without_albedo_reaches_everything(hand, scene):
    crop, truth, pose = scene
    lit = avatar_of(hand, truth, pose, crop.camera, EVEN._replace(albedo=None))
    torch.testing.assert_close(lit.pose(pose).colors, truth.colors)
    hidden = avatar_of(hand, truth, pose, crop.camera, EVEN).pose(pose).colors
    assert float((hidden / truth.colors).min()) < 0.6


def test_light_bounces_more_off_bright_skin_and_never_takes_any_away():
    share = torch.linspace(0, 1, 21)[:, None].expand(-1, 3)
    found = bounced(share, torch.tensor([0.05, 0.3, 0.7]))
    assert bool((found >= share).all()) and bool((found[1:] >= found[:-1]).all())
    assert float(found[10, 2]) > float(found[10, 1]) > float(found[10, 0]) >= 0.5
    torch.testing.assert_close(found[-1], torch.ones(3), atol=2e-3, rtol=0)


@pytest.mark.parametrize("rows", [4, 9])
def test_harmonics_turn_and_mirror_with_the_world(rows):
    generator = torch.Generator().manual_seed(rows)
    light = EVEN._replace(harmonics=torch.randn(rows, 3, generator=generator))
    n = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator), dim=1)
    turn = rotation.from_axis_angle(torch.tensor([0.0, 0.6, 0.8]), torch.tensor(0.9))
    before = harmonic_basis(n, rows) @ light.harmonics
    after = harmonic_basis(n @ turn.T, rows) @ rotate_light(light, turn).harmonics
    torch.testing.assert_close(after, before, atol=1e-5, rtol=1e-4)
    mirrored = harmonic_basis(mirror_points(n), rows) @ mirror_light(light).harmonics
    torch.testing.assert_close(mirrored, before)


def test_an_environment_map_lights_what_faces_its_bright_side():
    """Rows are from above to below (-y to y), the middle column is where the camera looks (z), right is x."""
    n = torch.eye(3)
    for middle, axis, sign in (((0.1, 0.5), 1, -1), ((0.5, 0.5), 2, 1), ((0.5, 0.75), 0, 1), ((0.5, 0.25), 0, -1)):
        rows, columns = torch.arange(32)[:, None] / 32, torch.arange(64) / 64
        spot = ((rows - middle[0]).abs() < 0.12) & (((columns - middle[1]).abs() < 0.06) | (middle[0] < 0.2))
        light = environment_light(0.5 + 20 * spot[..., None].float().repeat(1, 1, 3))
        towards, away = (harmonic_basis(s * sign * n[axis : axis + 1], 9) @ light for s in (1, -1))
        across = harmonic_basis(n[(axis + 1) % 3][None], 9) @ light
        assert float(towards.min()) > 1.5 * float(across.max()) and float(across.min()) > float(away.max())
        torch.testing.assert_close(light[0], torch.ones(3))


def test_even_surroundings_are_even_light_and_hue_stays():
    light = environment_light(torch.tensor([0.2, 0.4, 0.8]).expand(16, 32, 3))
    torch.testing.assert_close(light[0] / light[0, 1], torch.tensor([0.5, 1.0, 2.0]))
    assert float(light[1:].abs().max()) < 5e-3  # of rows
    assert float(studio_light()[:, 0] @ studio_light()[:, 0]) > 1.1


@pytest.mark.parametrize("left", [False, True])
def test_another_light_comes_from_the_same_side_for_both_hands(hand, scene, left):
    crop, truth, pose = scene
    avatar = avatar_of(hand, truth, pose, crop.camera, EVEN)
    avatar = as_left_hand(avatar) if left else avatar
    rows = torch.zeros(9, 3)
    rows[0], rows[1] = 1, -0.8  # from the left
    posed = avatar.in_light(rows).pose(avatar.source_pose)
    lighter = (posed.colors / truth.colors).mean(1)
    x = posed.means[:, 0]
    on_left, on_right = (lighter[where].mean() for where in (x < x.quantile(0.1), x > x.quantile(0.9)))
    assert float(on_left) > 1.2 * float(on_right)


def test_an_older_file_looks_as_before_in_its_photo_and_gains_elsewhere(hand, scene, tmp_path, monkeypatch):
    crop, truth, pose = scene
    old = avatar_of(hand, truth, pose, crop.camera, EVEN._replace(albedo=None))
    monkeypatch.setattr(avatar_file, "VERSION", 4)
    for k, avatar in enumerate((old, as_left_hand(old))):
        avatar.save(tmp_path / f"{k}.safetensors")
    monkeypatch.undo()
    for k, avatar in enumerate((old, as_left_hand(old))):
        read = Avatar.load(tmp_path / f"{k}.safetensors")
        source, opened = avatar.source_pose, avatar.source_pose._replace(angles=named_pose(hand, "pinch"))
        torch.testing.assert_close(read.pose(source).colors, avatar.pose(source).colors, atol=1e-3, rtol=0)
        assert float((read.pose(opened).colors / avatar.pose(opened).colors).min()) < 0.8


@pytest.mark.parametrize("version", [6, 7])
def test_a_file_with_other_light_in_hollows_looks_as_before_in_its_photo(hand, scene, tmp_path, monkeypatch, version):
    crop, truth, pose = scene
    old = avatar_of(hand, truth, pose, crop.camera, EVEN)
    old.save(tmp_path / "today.safetensors")
    with monkeypatch.context() as before:
        before.setattr(avatar_file, "VERSION", version)
        before.setattr(lit, "arriving", functools.partial(arriving_before, version))
        before.setattr(posing, "vertex_light", lit.vertex_light_in_steps)
        old.save(tmp_path / "old.safetensors")
        wanted = old.pose(old.source_pose).colors
    read, unchanged = (Avatar.load(tmp_path / f"{name}.safetensors") for name in ("old", "today"))
    darkest = lit.MIN_LIGHT ** (1 / lit.GAMMA)
    torch.testing.assert_close(read.pose(old.source_pose).colors, wanted, atol=darkest, rtol=0)
    assert float((unchanged.pose(old.source_pose).colors - wanted).abs().max()) > 0.01


def test_detail_that_takes_back_a_shadow_is_no_white_skin(hand, scene):
    """Bright detail beside a crease that lies a pixel off stayed white when the crease's shade was gone.

    Dark detail that overshot was a black hole in the skin, and detail in a shadow without blue an orange fleck.
    """
    _, truth, _ = scene
    colors, shade = torch.full_like(truth.colors, 0.5), torch.full_like(truth.colors, 0.62)
    shaded, every = truth._replace(colors=colors, shade=shade), torch.ones(len(colors), dtype=torch.bool)
    trust = torch.ones(len(colors), 1)
    cases = ((0.5, 0.5 * math.exp(0.3)), (0.33, 0.33 / 0.62), (0.25, 0.25 / 0.62), (0.001, 0.5 * math.exp(-0.5)))
    for shown, wanted in cases:
        made = with_photo_colors(shaded, every, torch.full_like(colors, shown), trust)
        assert made.shade is not None
        torch.testing.assert_close(made.colors, torch.full_like(colors, wanted))
        torch.testing.assert_close(made.colors * made.shade, torch.full_like(colors, shown))
        doubted = with_photo_colors(shaded, every, torch.full_like(colors, shown), 0 * trust)
        torch.testing.assert_close(doubted.colors, colors)
    dark = with_photo_colors(shaded._replace(shade=0.4 * shade), every, torch.full_like(colors, 0.2), trust)
    torch.testing.assert_close(dark.colors, colors)


@pytest.mark.parametrize("side", ["left", "right"])
def test_shade_fades_as_the_camera_leaves_the_photos_side(hand, scene, side):
    """Seen from the side, what photos showed on a slant were stains: black finger tips, bruises, streaks of floor."""
    crop, truth, pose = scene
    facing = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, EVEN).normals
    shaded = EVEN._replace(shade=torch.full_like(facing, 0.5), facing=facing)
    plain, dark = (avatar_of(hand, truth, pose, crop.camera, light) for light in (EVEN, shaded))
    if side == "left":
        plain, dark = as_left_hand(plain), as_left_hand(dark)
    source = dark.source_camera

    def ratio(degrees, nearer=1.0):
        return ratio_of_colors(plain, dark, camera_around(dark, degrees, nearer))

    assert ratio(0) == pytest.approx(0.5, abs=1e-3) and ratio(0, nearer=3) == pytest.approx(0.5, abs=1e-3)
    assert ratio(-22) == pytest.approx(ratio(22), abs=1e-3) and 0.6 < ratio(22) < 0.9
    assert ratio(40) == ratio(180) == 1
    assert torch.equal(dark.pose(dark.source_pose).colors, dark.pose(dark.source_pose, camera=source).colors)


def camera_around(avatar, degrees, nearer=1.0):
    """The photo's camera, moved around the middle of the hand, and `nearer` times as far away."""
    source, middle = avatar.source_camera, avatar.mesh(avatar.source_pose).vertices.mean(0)
    turn = rotation.from_axis_angle(torch.tensor([0.0, 1.0, 0.0]), torch.tensor(math.radians(degrees)))
    center = middle + nearer * turn @ (camera_center(source.viewmat) - middle)
    viewmat = torch.cat([torch.cat([turn.T, -(turn.T @ center)[:, None]], 1), source.viewmat[3:]])
    return source._replace(viewmat=viewmat)


def ratio_of_colors(plain, dark, camera):
    seen = [avatar.pose(avatar.source_pose, camera=camera).colors for avatar in (plain, dark)]
    return float((seen[1] / seen[0]).median())


@pytest.mark.parametrize("side", ["left", "right"])
def test_where_the_photo_is_in_doubt_the_gaussians_shade_ends_in_next_to_any_other_view(hand, scene, side):
    """What lay behind a thumb had the thumb's edge as soon as the view changed by a few degrees, or came nearer."""
    crop, truth, pose = scene
    facing = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, EVEN).normals
    shaded = truth._replace(shade=torch.full_like(truth.colors, 0.8))
    sure, doubted = (
        EVEN._replace(shade=torch.ones_like(facing), facing=facing, doubt=torch.full_like(facing[:, 0], doubt))
        for doubt in (0.0, 1.0)
    )
    plain, as_sure, as_doubted = (
        avatar_of(hand, each, pose, crop.camera, light)
        for each, light in ((truth, sure), (shaded, sure), (shaded, doubted))
    )
    if side == "left":
        plain, as_sure, as_doubted = map(as_left_hand, (plain, as_sure, as_doubted))
    for degrees, nearer, left in ((0, 1.0, 1), (8, 1.0, 0), (-8, 1.0, 0), (0, 0.25, 0)):
        camera = camera_around(plain, degrees, nearer)
        assert ratio_of_colors(plain, as_sure, camera) == pytest.approx(0.8, abs=1e-3)
        assert ratio_of_colors(plain, as_doubted, camera) == pytest.approx(1 - 0.2 * left, abs=1e-3)
    half = ratio_of_colors(plain, as_doubted, camera_around(plain, 5))
    assert 0.85 < half < 0.95


def test_a_camera_in_the_middle_of_the_hand_has_no_view_of_the_photo():
    """A division by its distance made all colours NaN."""
    assert view_shares(torch.tensor([0.0, 0.0, 0.4]), torch.zeros(3)).tolist() == [0.0, 0.0]


def test_many_poses_have_each_their_share_of_the_shade_that_a_camera_sees(hand, scene):
    crop, truth, pose = scene
    facing = posed_lighting(crop.rest.vertices, crop.posed.vertices, hand.faces, EVEN).normals
    shaded = EVEN._replace(shade=torch.full_like(facing, 0.5), facing=facing)
    avatar = avatar_of(hand, truth, pose, crop.camera, shaded)
    moved = pose._replace(translation=pose.translation + torch.tensor([0.2, 0.0, 0.0]))
    both = type(pose)(*(torch.stack(parts) for parts in zip(pose, moved, strict=True)))
    together = avatar.pose(both, camera=crop.camera).colors
    for own, each in zip(together, (pose, moved), strict=True):
        torch.testing.assert_close(own, avatar.pose(each, camera=crop.camera).colors)
    assert float((together[1] - together[0]).abs().mean()) > 0.05


def test_skin_that_touches_is_dark_where_the_hand_hides_the_sky():
    """Closed fingers were one lump of dough; flesh that came out on the other side was a black spot."""
    closeness = torch.tensor([0.0, 0.5, 1.0, 1.0])
    exposure = torch.tensor([0.2, 0.2, 0.2, 0.9])[:, None].expand(-1, 4)
    left = in_crevices(closeness, exposure)
    half = [(1 + least) / 2 for least in IN_CREVICES]
    torch.testing.assert_close(left, torch.tensor([(1.0, 1, 1), half, IN_CREVICES, (1, 1, 1)]))


def test_the_fist_of_an_avatar_is_darker_between_its_fingers(hand, monkeypatch):
    crop, truth, source = crop_of(hand, 0.8 * region_colors(label_regions(hand), 0.03), pose_name="open", size=48)
    avatar = avatar_of(hand, truth, source, crop.camera, None).in_light(studio_light())
    dark = avatar.pose("fist").colors
    monkeypatch.setattr(posing, "vertex_light", lit.vertex_light_in_steps)
    monkeypatch.setattr(lit, "in_crevices", lambda closeness, exposure: torch.ones_like(exposure[..., 1:]))
    change = (dark / avatar.pose("fist").colors)[: len(truth.vertex_index), 1]
    pose = avatar.held("fist")
    closeness = resolve_contact(hand, skin_surface(hand, avatar.rest, pose)).closeness
    assert closeness is not None
    closeness = closeness[truth.vertex_index]
    assert float(change[closeness > 0.5].median()) < 0.9
    assert float(change[closeness == 0].quantile(0.1)) == 1
