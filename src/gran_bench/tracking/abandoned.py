"""Runs whose process is gone: killed with ``kill -9``, for want of memory or by a power cut, they could not say so."""

from __future__ import annotations

import functools
import json
import os
import platform
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

if TYPE_CHECKING:
    from gran_bench.tracking.store import Store

PROCESS_TAG = "gran_bench.process"  # that records the run: its machine, its start and its number there
ENDED_TAG = "ended_by"  # what ended a run that did not finish
GONE = "its process is gone (killed, or the machine stopped)"


def this_process() -> str:
    """What tells this process from every other one, on any machine and at any time; for ``PROCESS_TAG``."""
    pid = os.getpid()
    return json.dumps(
        {"host": platform.node(), "machine": _machine(), "boot": _boot(), "pid": pid, "start": _start(pid)}
    )


def close_abandoned(store: Store) -> list[str]:
    """Mark as ``KILLED`` each run that is ``RUNNING`` without its process, and tell their names.

    Args:
        store: held alone.

    Returns:
        Names, with their machines, of the runs of other machines: whether those go on is not known here.
    """
    closed, elsewhere = {}, []
    for run in store.running():
        process = _process_of(run.data.tags)
        if process is None:
            elsewhere.append(f"{run.info.run_name} (machine unknown)")
        elif process["machine"] != _machine():
            elsewhere.append(f"{run.info.run_name} ({process['host']})")
        # Its process may have ended it after it was found here, so it is looked at again.
        elif _is_gone(process) and store.status_of(run.info.run_id) == "RUNNING":
            closed[run.info.run_id] = run.info.run_name
    for run_id in closed:
        store.add_tags(run_id, {ENDED_TAG: GONE})
        store.close_run(run_id, "KILLED")
    if closed:
        print(f"marked as KILLED, because {GONE}: {', '.join(closed.values())}", file=sys.stderr, flush=True)
    return elsewhere


def _process_of(tags: Mapping[str, str]) -> dict[str, object] | None:
    try:
        return json.loads(tags[PROCESS_TAG])
    except (KeyError, ValueError):
        return None


def _is_gone(process: Mapping[str, object]) -> bool:
    """Whether a process of this machine is there no more; its number may be another process's by now."""
    return process["boot"] != _boot() or process["start"] != _start(int(process["pid"]))


@functools.cache
def _machine() -> str:
    """This machine; of a container, too, which sees no process of its host's."""
    known = [platform.node()]
    with suppress(OSError):
        known.append(Path("/etc/machine-id").read_text().strip())
    with suppress(OSError):
        known.append(os.readlink("/proc/self/ns/pid"))
    return " ".join(known)


@functools.cache
def _boot() -> str:
    """The machine's last start."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return f"{psutil.boot_time():.0f}"


def _start(pid: int) -> str | None:
    """When a process started; None where there is none, or a dead one that nobody has waited for."""
    try:
        process = psutil.Process(pid)
        if process.status() in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD):
            return None
        # In ticks since the machine's start: seconds since 1970 would change when its clock is set.
        ticks = Path(f"/proc/{pid}/stat")
        return ticks.read_text().rpartition(")")[2].split()[19] if ticks.exists() else f"{process.create_time():.2f}"
    except (OSError, psutil.Error):
        return None
