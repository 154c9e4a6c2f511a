"""What all tests share."""

import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

HERE = Path(__file__).parent
SLOW = (HERE / "faults", HERE / "integration")


def pytest_configure() -> None:
    """Let processes that tests start hear Ctrl-C, even where a shell runs pytest in the background and ignores it.

    And let no test record on a server of whoever runs them.
    """
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All tests of some folders are slow."""
    for item in items:
        if item.path.is_relative_to(SLOW[0]) or item.path.is_relative_to(SLOW[1]):
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def full_at() -> Callable[[int], AbstractContextManager[None]]:
    """A disk that is full: while ``full_at(size)`` lasts, no file of this process grows beyond ``size`` bytes.

    The kernel's limit on the size of a file does what a full disk does, at any byte, without a disk or a privilege.
    """

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limited
