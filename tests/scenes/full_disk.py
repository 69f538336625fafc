"""A disk on which no file gets larger than a limit, as on one that is full."""

import resource
from contextlib import contextmanager


@contextmanager
def files_end_at(size):
    """Let writes beyond `size` bytes of a file fail while the body runs; Python ignores the signal
    of the limit.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
