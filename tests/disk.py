"""A disk that is full, without filling one."""

import contextlib
import resource
import signal


@contextlib.contextmanager
def full_disk(n_bytes: int):
    """Let no file grow beyond `n_bytes`: writes fail in this process as on a full disk, C++ libraries' included."""
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
