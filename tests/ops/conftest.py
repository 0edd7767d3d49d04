import jaxtyping
import pytest


@pytest.fixture
def as_shipped():
    """Without the run-time shape hook of the tests, which would speak before our own checks."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
