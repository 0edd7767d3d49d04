import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import oasis_warp
from oasis_warp import reconstruction
from oasis_warp.assets import asset
from oasis_warp.core.processes import kernel_threads, single_threaded_math


def blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_blas_has_one_thread_inside_and_as_many_as_before_afterwards():
    with threadpool_limits(limits=2, user_api="blas"):
        before, ours = blas_threads(), kernel_threads()
        with single_threaded_math():
            assert blas_threads() == {1} and kernel_threads() == ours
        assert blas_threads() == before


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
