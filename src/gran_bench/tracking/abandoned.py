"""Runs whose process is gone: killed with ``kill -9``, for want of memory or by a power cut, they could not say so."""

import functools
import json
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path

import psutil

from gran_bench.tracking.names import STOPPED, VERDICT
from gran_bench.tracking.store import Store

PROCESS_TAG = "gran_bench.process"  # that records the run: its machine, its start and its number there
ENDED_TAG = "ended_by"  # what ended a run that did not finish
GONE = "its process is gone (killed, or the machine stopped)"


def this_process() -> str:
    """What tells this process from every other one, on any machine and at any time; for ``PROCESS_TAG``."""
    return json.dumps({"host": platform.node(), **_machine(), "pid": os.getpid(), "start": _start(os.getpid())})


def close_abandoned(store: Store) -> list[str]:
    """Mark as ``KILLED`` each run of a store, held alone, that is ``RUNNING`` without its process.

    Returns the names, with their machines, of the runs of other machines: whether those go on is not known here.
    """
    closed, elsewhere = [], []
    for run in store.running():
        run_id, name, here = run.info.run_id, run.info.run_name, _machine()
        try:
            process = json.loads(run.data.tags[PROCESS_TAG])
        except (KeyError, ValueError):
            process = {"host": "machine unknown", "machine": None}
        if process["machine"] != here["machine"]:
            elsewhere.append(f"{name} ({process['host']})")
            continue
        # Its number may be another process's by now.
        gone = process["boot"] != here["boot"] or process["start"] != _start(int(process["pid"]))
        # Its process may have ended it after it was found here, so it is looked at again.
        if gone and store.status_of(run_id) == "RUNNING":
            store.add_tags(run_id, {ENDED_TAG: GONE, VERDICT: STOPPED})
            store.client.set_terminated(run_id, "KILLED")
            closed.append(name)
    if closed:
        print(f"marked as KILLED, because {GONE}: {', '.join(closed)}", file=sys.stderr, flush=True)
    return elsewhere


@functools.cache
def _machine() -> dict[str, str]:
    """This machine (of a container, too, which sees no process of its host's), and its last start."""
    known, boot = [platform.node()], f"{psutil.boot_time():.0f}"
    with suppress(OSError):
        known.append(Path("/etc/machine-id").read_text().strip())
    with suppress(OSError):
        known.append(os.readlink("/proc/self/ns/pid"))
    with suppress(OSError):
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return {"machine": " ".join(known), "boot": boot}


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
