from pathlib import Path

import pytest
import torch

from oasis_warp.core.camera import project
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.mirror import mirror_pose
from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator, choose_hand
from oasis_warp.hand.skinning import hand21, rest_hand, skin
from oasis_warp.reconstruction import crop_hand, crop_landmarks, initial_offsets, reconstruct

PHOTO = Path(__file__).parent / "data" / "photos" / "thumb_up_left_06.jpg"


def test_landmarks_of_a_left_hand_lie_on_the_mirrored_model(hand):
    photo, estimator = read_photo(PHOTO), HandEstimator(hand)
    fit = estimator.fit(photo, choose_hand(estimator.find(photo), "left", photo.name))
    crop = crop_hand(photo, fit, initial_offsets(hand, fit), ReconstructConfig())
    model = hand21(skin(hand, rest_hand(hand, fit.shape), mirror_pose(fit.pose)), hand)
    away = crop_landmarks(fit, crop.camera) - project(crop.camera, model)[0]
    assert away.norm(dim=1).median() < 8  # px of 256; the mirror image would be a hundred away


@pytest.mark.slow
def test_refinement_of_a_left_hand_moves_it_and_keeps_it_on_its_photo(hand):
    made = {
        switch: reconstruct(read_photo(PHOTO), ReconstructConfig(refine=switch, prior="none", steps=0))
        for switch in ("on", "off")
    }
    on, off = made["on"], made["off"]
    assert off.errors["refined_px"] == 0
    assert 0 < on.errors["refined_px"] < 20
    assert not torch.equal(on.fit.pose.angles, off.fit.pose.angles)
    assert on.errors["reprojection_percent"] < 2.3
    assert on.errors["render_mask_iou"] > off.errors["render_mask_iou"] - 0.02
