"""A command in a process group of its own that ends with whoever started it, however that one ends.

A group of its own is what ``kill -9`` can strike as a whole, but neither Ctrl-C nor the death of the process that
started it reaches it. So the first process of the group, ``python -m gran_bench.stability.process_group``, does nothing
but start the command, watch, and end with the command's exit code.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import gran_bench

WATCH_SECONDS = 0.2  # between two looks whether the parent is still there


@contextmanager
def group(command: list[str], folder: Path, environment: Mapping[str, str]) -> Iterator[subprocess.Popen]:
    """A command in a process group of its own; what is left of the group when the block ends is killed.

    Args:
        command: of the group.
        folder: that it works in; gets what it says, in ``said.txt``.
        environment: beside that of this process.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sources = str(Path(gran_bench.__file__).parent.parent)
    paths = os.pathsep.join([sources, *filter(None, [os.environ.get("PYTHONPATH")])])
    watched = [sys.executable, "-m", "gran_bench.stability.process_group", str(os.getpid()), *command]
    with open(folder / "said.txt", "ab") as said:
        process = subprocess.Popen(
            watched, cwd=folder, env=os.environ | {"PYTHONPATH": paths} | environment,
            stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True,
        )  # fmt: skip
    try:
        yield process
    finally:
        kill_group(process)


def kill_group(process: subprocess.Popen) -> None:
    """``kill -9`` of a process and of all in its group, where it has not ended by itself."""
    if process.poll() is None:  # once it is reaped, its number may be another's
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def end_with_parent(parent: int) -> None:
    """Kill the group of this process, itself too, once its parent is another one than ``parent``; in a thread."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def main(parent: int, command: list[str]) -> int:
    """Run the command to its end, or until the parent is gone; its exit code, as a shell gives it."""
    end_with_parent(parent)
    code = subprocess.run(command, check=False).returncode
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:]))
