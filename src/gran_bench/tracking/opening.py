"""Opening a run: a new one, or the one that the same key has already, and closing it with the right status."""

import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any

from gran_bench.config import TrackingConfig
from gran_bench.tracking.abandoned import ENDED_TAG, GONE, PROCESS_TAG, close_abandoned, this_process
from gran_bench.tracking.names import FAILED, STOPPED, VERDICT, shown_name
from gran_bench.tracking.run import Run, send_kept
from gran_bench.tracking.store import SWEEP_TAG, Store, TrackingError, said_place


@contextmanager
def open_run(
    config: TrackingConfig,
    name: str,
    key: str,
    params: Mapping[str, Any] | object,
    tags: Mapping[str, object] | None = None,
    parent: str | None = None,
) -> Iterator[Run]:
    """Open a run, a new one or the one that the same key has already, and close it with the right status.

    ``FINISHED`` when the block ends, ``KILLED`` on Ctrl-C and SIGTERM, ``FAILED`` on any other exception. A run
    whose process was killed outright stays ``RUNNING`` until the next run is opened on the machine, or the UI.

    Args:
        config: where, or that nothing is recorded.
        name: for people.
        key: hash of what determines the result; the same key is the same run.
        params: nested config; recorded with dotted names. One that changed since the run began becomes a tag.
        tags: data digest, commit, hardware, …
        parent: id of the run that this one belongs to.

    A store that cannot be opened, or that lacks something at the end, is a `TrackingError`.
    """
    if not config.enabled:
        yield Run()
        return
    if (place := said_place(config)) is not None:
        print(place, file=sys.stderr, flush=True)
    with _terminable():
        run = _open(Store(config), name, key, dotted(params), dict(tags or {}), parent)
        try:
            yield run
        except BaseException as error:
            run.set_tag(ENDED_TAG, f"{type(error).__name__}: {error}")
            stopped = isinstance(error, KeyboardInterrupt)
            run.set_tag(VERDICT, STOPPED if stopped else FAILED)
            try:
                run.finish("KILLED" if stopped else "FAILED")
            except TrackingError as second:
                # The first error matters more; the second must not hide it.
                print(f"warning: {second}", file=sys.stderr)
            raise
        run.finish("FINISHED")


def _open(
    store: Store, name: str, key: str, params: dict[str, str], tags: dict[str, object], parent: str | None
) -> Run:
    # A sweep's own row is the only one that its recipe's name tells from others.
    shown = name if tags.get(SWEEP_TAG) == name else shown_name(name)
    process = {PROCESS_TAG: this_process()}
    # Two processes with one key must not both find nothing and make two runs.
    with store.alone():
        send_kept(store)
        found = store.run_of(key)
        if found is None:
            run_id = store.create_run(shown, key, parent, tags=process)
        else:
            run_id = found.info.run_id
            store.add_tags(run_id, process)
            store.reopen_run(run_id, shown, (ENDED_TAG, VERDICT))
            if parent is not None:
                store.adopt_run(run_id, parent)
        changed = store.add_params(run_id, params)
        close_abandoned(store)
    run = Run(store, run_id, resumed=found is not None)
    for label, value in (tags | {f"resumed_with.{param}": value for param, value in changed.items()}).items():
        run.set_tag(label, value)
    run.flush()
    return run


def dotted(params: Mapping[str, Any] | object, prefix: str = "") -> dict[str, str]:
    """Nested parameters by dotted name, as text."""
    if is_dataclass(params) and not isinstance(params, type):
        params = asdict(params)
    flat: dict[str, str] = {}
    for name, value in params.items():
        nested = isinstance(value, Mapping) and value
        flat |= dotted(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": str(value)}
    return flat


@contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM end the block like Ctrl-C, where nobody handles it already; or the run stays RUNNING for ever."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt(signal.Signals(number).name)

    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@dataclass(frozen=True)
class Child:
    """A run of a sweep before its job starts: its name, its key, and whether its result is there already."""

    name: str
    key: str
    finished: bool = False


def schedule_children(config: TrackingConfig, parent: str | None, children: Iterable[Child]) -> set[str]:
    """Make a run ``SCHEDULED`` for each child that has none, and put all of them under their parent's run.

    A child that has a run already keeps it: one that is finished stays as it is, any other waits to start again. One
    of another sweep stays there, and names both sweeps in its tag. Without tracking there is no parent (None).

    Returns:
        Keys of the children that are finished while the store does not say so: their record is missing there.
    """
    if parent is None:
        return set()
    store, missing = Store(config), set()
    with store.alone():
        for child in children:
            run, shown = store.run_of(child.key), shown_name(child.name)
            if run is None:
                store.create_run(shown, child.key, parent, "SCHEDULED")
            else:
                store.adopt_run(run.info.run_id, parent)
            if child.finished and (run is None or run.info.status != "FINISHED"):
                missing.add(child.key)
            elif not child.finished and run is not None:
                store.reopen_run(run.info.run_id, shown, (ENDED_TAG, VERDICT), "SCHEDULED")
    return missing


@contextmanager
def reopen_ended(config: TrackingConfig, key: str) -> Iterator[Run | None]:
    """The run of a key, to add to what it records without a change of its status; None where there is none."""
    store = Store(config)
    found = store.run_of(key)
    run = None if found is None else Run(store, found.info.run_id, resumed=True)
    yield run
    if run is not None:
        run.send()


def end_child(config: TrackingConfig, key: str, why: str) -> None:
    """Mark a run that its own process could not close as ``FAILED``, with the reason."""
    if not config.enabled:
        return
    store = Store(config)
    with store.alone():
        run = store.run_of(key)
        # Another process may have found before that this one's is gone, without knowing why.
        if run and (run.info.status in ("SCHEDULED", "RUNNING") or run.data.tags.get(ENDED_TAG) == GONE):
            store.add_tags(run.info.run_id, {ENDED_TAG: why, VERDICT: FAILED})
            store.client.set_terminated(run.info.run_id, "FAILED")
