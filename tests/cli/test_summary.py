import numpy as np
import torch

from oasis_warp.avatar.quality import SurfaceQuality
from oasis_warp.cli.summary import (
    FINGER_COLORS,
    PAPER,
    POSES,
    VIEWS,
    WIDTH,
    Panel,
    draw_landmarks,
    draw_mesh,
    draw_quality,
    draw_summary,
    make_sheet,
    panel_side,
    shade_mesh,
)


def test_the_summary_has_three_rows_of_panels_that_all_show_something(scene, made):
    reports = []
    sheet = draw_summary([scene[0]], made, progress=lambda *report: reports.append(report)).numpy()
    assert sheet.shape[1] == WIDTH
    total = 1 + VIEWS + len(POSES)
    assert reports == [("summary", n, total) for n in range(1, total + 1)]
    painted = (sheet != PAPER).any(-1)[:, 60].astype(int)  # a column through the first panel of each row
    rows = np.diff(np.flatnonzero(np.diff(painted)))
    for n_panels in (4, VIEWS, len(POSES)):
        assert panel_side(n_panels, WIDTH) in rows


def test_the_avatars_panel_matches_the_photos(scene, made):
    sheet = draw_summary([scene[0]], made).numpy().astype(int)
    side, top = panel_side(4, WIDTH), 24 + 44
    photo, _, mask, avatar = (sheet[top : top + side, 24 + k * (side + 12) :][:, :side] for k in range(4))
    hand = mask[..., 0] > 250
    assert np.abs(photo[hand] - (200, 150, 120)).max() <= 5  # the edge blends in
    assert np.abs(avatar[hand].mean(0) - (200, 150, 120)).max() < 15
    assert (avatar[mask[..., 0] < 5].mean(0) > 220).all()


def test_doubts_are_mentioned(scene, made):
    sure, doubtful = (draw_summary([scene[0]], made._replace(warnings=w)) for w in ((), ("a finger is hidden",)))
    assert (sure[:68] != doubtful[:68]).any()
    assert torch.equal(sure[68:], doubtful[68:])


def test_a_surface_is_brightest_where_it_faces_the_camera(scene, hand):
    _, fit, avatar = scene
    shade, inside = shade_mesh(avatar.mesh(fit.pose), hand.faces, fit.camera)
    assert torch.equal(inside, fit.mask)
    assert (shade[inside == 0] == 0).all()
    assert 0.34 < shade[inside == 1].min() < 0.7
    assert 0.95 < shade.max() <= 1.0001


def test_landmarks_are_drawn_where_they_are():
    points = np.stack([np.linspace(10, 90, 21), np.tile([20.0, 50.0, 80.0], 7)], 1)
    drawn = draw_landmarks(np.zeros((100, 100, 3), np.uint8), points)
    for finger, color in enumerate(FINGER_COLORS):
        x, y = points[4 * finger + 4]
        assert tuple(drawn[int(y), int(x)]) == color


def test_a_mesh_leaves_the_picture_around_it_alone():
    picture = np.full((60, 60, 3), 77, np.uint8)
    inside = np.zeros((60, 60))
    inside[20:40, 20:40] = 1
    drawn = draw_mesh(picture, inside, inside)
    assert (drawn[:18] == 77).all()
    assert (drawn[25:35, 25:35] != 77).all()


def test_panels_stand_beside_each_other_untouched():
    panels = [Panel(np.full((panel_side(2, 200),) * 2 + (3,), value, np.uint8), "x") for value in (10, 90)]
    sheet = make_sheet("title", "more", [panels], 200)
    assert (sheet == 10).all(-1).sum() >= panel_side(2, 200) ** 2
    assert (sheet == 90).all(-1).sum() >= panel_side(2, 200) ** 2


def panels(made, visibility):
    quality = SurfaceQuality(visibility, 1 - visibility)
    sheet = draw_quality("a hand", made.avatar, quality).numpy()
    side, top = panel_side(4, WIDTH), 24 + 44
    assert sheet.shape[1] == WIDTH
    return [sheet[top : top + side, 24 + k * (side + 12) :][:, :side].astype(float) for k in range(4)]


def hue(panel):
    """Mean colour of what is no background, as shares."""
    color = panel[np.ptp(panel, axis=-1) > 12].mean(0)
    return color / color.sum()


def test_each_side_of_the_hand_is_shown_in_the_colours_of_what_is_known_of_it(made):
    n = len(made.avatar.hand.template)
    seen, unseen = panels(made, torch.ones(n)), panels(made, torch.full((n,), 0.1))
    assert hue(seen[0])[1] > 0.42 and hue(seen[1])[1] > 0.42  # green, from both sides
    assert hue(unseen[0])[0] > hue(unseen[0])[1] > hue(unseen[0])[2]  # yellow
    assert hue(seen[2])[2] > 0.4 and hue(unseen[2])[2] < 0.25  # blue where it is sure


def test_the_palm_and_the_back_are_told_apart(made):
    palm = (made.avatar.mesh(made.fit.pose).vertices[:, 2] < 0.6).float()  # the camera looks along z
    front, behind, *_ = panels(made, palm)
    green = [(np.argmax(panel, -1) == 1).mean() for panel in (front, behind)]
    assert green[0] > 2 * green[1]
