"""Files that are whole or not there at all, and locks that die with the process that holds them.

A file is written under a temporary name in its own folder, fsynced and renamed, whenever power fails or a kill strikes.
"""

import fcntl
import glob
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

NUMBER = r"[−-]?[\d.]+(e[+-]?\d+)?|[–]?"  # or that there is none


@contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary name to write to; it takes the final name, in a folder that is made, if the block ends well."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        _sync(temporary)
        temporary.replace(path)
        # The rename itself lives in the folder, so the folder needs its own sync to survive a power cut.
        _sync(path.parent)
    except OSError as error:
        if error.filename is None:  # a write that fails does not know what it was writing
            error.filename = str(path)
        raise
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


def write_atomically(path: Path | str, write: Callable[[BinaryIO], object]) -> None:
    """Call ``write`` with a binary file that becomes ``path``, whole or not at all."""
    with whole_file(path) as temporary, open(temporary, "wb") as file:
        write(file)


def write_text(path: Path | str, text: str) -> None:
    """Write UTF-8 text to ``path``, whole or not at all."""
    write_atomically(path, lambda file: file.write(text.encode()))


def write_part(path: Path, part: str, text: str, title: str = "", heading: str = "") -> None:
    """Renew what stands between the marks ``<!-- part -->`` and ``<!-- end -->`` of a page; the rest is people's.

    A page is made with a title where it is missing; a part that it does not have comes to its end, under a heading.
    """
    page = path.read_text("utf-8") if path.exists() else f"# {title}\n" if title else ""
    opening, closing = f"<!-- {part} -->\n", "<!-- end -->\n"
    before, found, rest = page.partition(opening)
    if not found:
        above = [before.rstrip(), f"## {heading}" if heading else ""]
        before = "".join(f"{words}\n\n" for words in above if words)
    write_text(path, before + opening + f"{text.strip()}\n" + closing + rest.partition(closing)[2])


def markdown(rows: Iterable[Sequence[str]], aligned: bool = False) -> list[str]:
    """Lines of a Markdown table whose first row is its heading, none without a second; aligned ones suit terminals.

    Columns of numbers stand to the right.
    """
    rows = list(rows)
    widths = [max(map(len, column)) if aligned else 0 for column in zip(*rows, strict=True)]
    lines = [f"| {' | '.join(map(str.ljust, row, widths))} |" for row in rows]
    numbers = (all(re.fullmatch(NUMBER, cell) for cell in column) for column in zip(*rows[1:], strict=True))
    rules = ("-" * max(width + 1, 2) + "-:"[right] for width, right in zip(widths, numbers, strict=False))
    lines.insert(1, f"|{'|'.join(rules)}|")
    return lines if len(rows) > 1 else []


def remove_leftovers(path: Path | str) -> None:
    """Remove what killed writers of ``path`` left behind; only for whoever holds the lock of ``path``."""
    path = Path(path)
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        leftover.unlink(missing_ok=True)


@contextmanager
def locked(path: Path | str, waiting: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Hold an exclusive lock on a file, which stays; ``waiting`` is called once if another process holds it."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            waiting()
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
