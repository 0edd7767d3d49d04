from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

import oasis_warp
from oasis_warp import reconstruction
from oasis_warp.assets import asset
from oasis_warp.core.processes import kernel_threads, single_threaded_math, using_threads


def blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_blas_has_one_thread_inside_and_as_many_as_before_afterwards():
    with threadpool_limits(limits=2, user_api="blas"):
        before, ours = blas_threads(), kernel_threads()
        with single_threaded_math():
            assert blas_threads() == {1} and kernel_threads() == ours
        assert blas_threads() == before


def threads():
    return blas_threads(), torch.get_num_threads(), kernel_threads()


@pytest.fixture
def three_threads_and_two_of_blas():
    """Set in threads that end: threadpoolctl lets no other thread change BLAS while one that did is alive."""
    with using_threads(3):
        with ThreadPoolExecutor(1) as pool:
            limits = pool.submit(threadpool_limits, limits=2, user_api="blas").result()
        yield
        with ThreadPoolExecutor(1) as pool:
            pool.submit(limits.restore_original_limits).result()


@pytest.mark.parametrize("first", [0, 1])
def test_limits_stay_until_the_last_of_several_threads_leaves(first, three_threads_and_two_of_blas):
    """Torch's number belongs to each thread, that of BLAS to the process."""
    last, blocks = 1 - first, [single_threaded_math(), single_threaded_math()]
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(1) as other:
        pools = [one, other]
        for pool, block in zip(pools, blocks, strict=True):
            pool.submit(block.__enter__).result()
        assert [pool.submit(threads).result() for pool in pools] == [({1}, 1, 3)] * 2
        pools[first].submit(blocks[first].__exit__, None, None, None).result()
        assert pools[last].submit(threads).result() == ({1}, 1, 3)
        pools[last].submit(blocks[last].__exit__, None, None, None).result()
        assert [pool.submit(threads).result() for pool in pools] == [({2}, 3, 3)] * 2 == [threads()] * 2


def test_a_block_inside_another_changes_nothing():
    with using_threads(3), single_threaded_math():
        with single_threaded_math():
            assert threads()[1:] == (1, 3)
        assert threads()[1:] == (1, 3)


def test_a_photo_has_one_blas_thread_from_python_too(monkeypatch):
    """The command line asks for one before NumPy is loaded; Python callers have loaded it with many, which spin."""
    found = []

    def stop(*_):
        found.append(blas_threads())
        raise InterruptedError

    monkeypatch.setattr(reconstruction, "choose_prior", stop)
    with threadpool_limits(limits=2, user_api="blas"), pytest.raises(InterruptedError):
        oasis_warp.reconstruct(str(asset("photos", "palm_open_left_02.png")))
    assert found == [{1}]
