from pathlib import Path

import pytest

from oasis_warp.data.photo import read_photo
from oasis_warp.estimation.estimator import HandEstimator
from oasis_warp.hand.kinematics import HandKinematics

PHOTOS = Path(__file__).parents[1] / "data" / "photos"


@pytest.fixture(scope="session")
def photos():
    """Folder of the test photos."""
    return PHOTOS


@pytest.fixture(scope="session")
def estimator(hand):
    return HandEstimator(hand)


@pytest.fixture(scope="session")
def kinematics(hand):
    return HandKinematics(hand)


@pytest.fixture(scope="session")
def fitted(estimator):
    """Photo, landmarks and fit by file name, each computed once a session."""
    done = {}

    def get(name):
        if name not in done:
            photo = read_photo(PHOTOS / name)
            landmarks = estimator.find(photo)[0]
            done[name] = photo, landmarks, estimator.fit(photo, landmarks, force=True)
        return done[name]

    return get
