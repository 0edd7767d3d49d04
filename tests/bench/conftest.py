import pytest
import torch

from oasis_warp.bench.scenes import layered
from oasis_warp.bench.timing import using_threads


@pytest.fixture
def small():
    """A layered scene that is drawn in a millisecond."""
    return layered(n=300, size=16)


@pytest.fixture(autouse=True)
def one_thread():
    with using_threads(1):
        yield


@pytest.fixture
def cpu():
    return torch.device("cpu")
