import os
import shutil

import pytest
import torch
from torch.utils import cpp_extension

from oasis_warp.ops._runtime import picture_extension, picture_node
from oasis_warp.ops._runtime.plans import Plans


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request):
    return request.param


@pytest.fixture
def with_threads():
    """Calls a function while torch, and so our CPU launches, use the given number of threads."""
    before = torch.get_num_threads()

    def call(n_threads, function, *args):
        torch.set_num_threads(n_threads)
        return function(*args)

    yield call
    torch.set_num_threads(before)


@pytest.fixture
def extension(request, monkeypatch):
    """The node, built once for all runs of the tests: nobody else shall find and use it."""
    monkeypatch.setenv("OASIS_WARP_CACHE", str(request.config.cache.mkdir("extension")))
    monkeypatch.delenv(picture_extension.VARIABLE, raising=False)
    picture_extension._load.cache_clear()
    if not (shutil.which(os.environ.get("CXX", "c++")) and shutil.which("ninja")):
        pytest.skip("needs a C++ compiler and ninja")
    if not picture_extension.is_built():
        load = cpp_extension.load  # without optimisation, which takes a third of the time and changes no result
        with monkeypatch.context() as patch:
            quick = {"extra_cflags": ["-O0"]}
            patch.setattr(cpp_extension, "load", lambda *named, **options: load(*named, **options | quick))
            picture_extension.build()
    module = picture_extension.loaded()
    assert module is not None
    monkeypatch.setattr(picture_node, "_plans", Plans())
    yield module
    picture_extension._load.cache_clear()
