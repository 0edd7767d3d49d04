import pytest
import torch


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
