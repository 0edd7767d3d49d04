import pytest
import torch


@pytest.fixture
def with_threads():
    """Calls a function while torch, and so our CPU launches, use the given number of threads."""
    before = torch.get_num_threads()

    def call(n_threads, function, *args):
        torch.set_num_threads(n_threads)
        return function(*args)

    yield call
    torch.set_num_threads(before)
