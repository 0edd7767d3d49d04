import cv2
import numpy as np
import pytest

from oasis_warp.core.errors import InputError
from oasis_warp.estimation import networks as module
from oasis_warp.estimation.networks import Networks, check_networks, drawn_hand, networks


def test_this_installation_computes_the_networks_rightly():
    check_networks()


def test_the_drawing_shows_an_open_right_hand():
    seen = networks().hand(drawn_hand(224))
    assert seen.presence > 0.7
    assert seen.right > 0.9
    assert seen.points[8, 1] < seen.points[5, 1] < seen.points[0, 1], "the index finger points up"


def test_an_old_opencv_is_refused_before_it_can_answer_wrongly(monkeypatch):
    monkeypatch.setattr(cv2, "__version__", "4.11.0")
    with pytest.raises(InputError, match=r"OpenCV 4\.11\.0: .*install opencv-contrib-python-headless 5"):
        networks.__wrapped__()


@pytest.mark.parametrize("fault", ["points", "world", "side"])
def test_a_version_that_computes_wrongly_is_refused(monkeypatch, fault):
    right = Networks.hand

    def wrong(self, image):
        seen = right(self, image)
        # As large as what OpenCV 4.11 gets wrong: 3 px and 0.27 m.
        changes = {"points": seen.points + 3.0, "world": seen.world + 0.27, "side": seen.right - 0.5}
        key = {"side": "right"}.get(fault, fault)
        return module.HandOutput(**{**vars(seen), key: changes[fault]})

    monkeypatch.setattr(Networks, "hand", wrong)
    with pytest.raises(InputError, match="computes the hand networks wrongly"):
        networks.__wrapped__()


def test_a_detector_that_computes_wrongly_is_refused(monkeypatch):
    right = Networks.palm
    monkeypatch.setattr(Networks, "palm", lambda self, image: right(self, np.zeros_like(image)))
    with pytest.raises(InputError, match="computes the hand networks wrongly"):
        networks.__wrapped__()


def test_outputs_that_cannot_be_read_are_refused(monkeypatch):
    monkeypatch.setattr(module, "_HAND_OUTPUTS", ("Identity", "Identity_1", "Identity_2", "no_such_output"))
    with pytest.raises(InputError, match="cannot run the hand networks"):
        networks.__wrapped__()


def test_a_damaged_network_file_is_refused(monkeypatch):
    files = dict.fromkeys(module._FILES, "0" * 64)
    monkeypatch.setattr(module, "_FILES", files)
    with pytest.raises(InputError, match=r"palm_detection_full\.tflite: the network file is damaged"):
        networks.__wrapped__()
