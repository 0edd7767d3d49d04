import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported; xdist's workers inherit it:
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")  # processes run in parallel, so threads would only compete

import jaxtyping
import pytest
import torch

MAX_WORKERS, MAX_ON_GPU = 8, 2
"""Each takes up to a gigabyte of memory, and one on the device."""
THREADS = torch.get_num_threads()


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the tests marked slow too")


@pytest.hookimpl(wrapper=True)
def pytest_xdist_auto_num_workers(config):
    """A process per core for folders, none for single files, which would end before the workers have started."""
    cores = yield
    if any(".py" in argument for argument in config.args):
        return 0
    return min(cores, MAX_ON_GPU if torch.cuda.is_available() else MAX_WORKERS)


def pytest_collection_modifyitems(config, items):
    """Deselect slow tests unless --slow is given, and GPU tests on machines without CUDA."""
    without = set()
    if not config.getoption("--slow"):
        without.add("slow")
    if not torch.cuda.is_available():
        without.add("gpu")
    dropped = [item for item in items if without & item.keywords.keys()]
    if dropped:
        config.hook.pytest_deselected(items=dropped)
        items[:] = [item for item in items if not without & item.keywords.keys()]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown():
    """Fail a test that leaves torch with other threads: while they wait they spin, and make all later tests slow."""
    done = yield
    left = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    assert left == THREADS, f"torch is left with {left} threads, not {THREADS}"
    return done


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    return torch.device(request.param)


@pytest.fixture
def as_shipped():
    """Run without the shape checks of the test hook, which would fire before our own messages."""
    was = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", was)


@pytest.fixture(scope="session")
def mano_dir(tmp_path_factory):
    """A folder with files in MANO's format."""
    from mano_files import write_mano

    return write_mano(tmp_path_factory.mktemp("mano"))


@pytest.fixture(scope="session")
def mano(mano_dir):
    from oasis_warp.hand.mano_hand import mano_hand

    return mano_hand(mano_dir)


@pytest.fixture(scope="session")
def hand():
    from oasis_warp.hand.template import bundled_hand

    return bundled_hand()
