import numpy as np
import torch

from oasis_warp.avatar.quality import SurfaceQuality
from oasis_warp.cli.summary import WIDTH, draw_quality, panel_side


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
