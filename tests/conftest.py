"""What all tests share."""

import os
import signal


def pytest_configure() -> None:
    """Let processes that tests start hear Ctrl-C, even where a shell runs pytest in the background and ignores it.

    And let no test record on a server of whoever runs them.
    """
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
