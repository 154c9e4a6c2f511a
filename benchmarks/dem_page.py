"""A table of a DEM benchmark, kept with the command, the commit and the hardware that made it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from gran_bench.atomic import write_text
from gran_bench.provenance import commit, hardware, provenance, write_origin

FOLDER = Path("results/dem_speed")
INTERPRETER = "--lammps-python"  # an option whose value is a place on somebody's machine


def typed_command() -> str:
    """The command line as a reader would type it, with LAMMPS' interpreter where the benchmarks say that it is made."""
    words = ["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]]
    for place, word in enumerate(words[:-1]):
        if word == INTERPRETER:
            words[place + 1] = "lammps-venv/bin/python"
    return " ".join(words)


def keep(name: str, text: str, output: Path | None, rows: Sequence[dict[str, object]] = ()) -> None:
    """Prints the text and, where a folder is given, writes it to ``<name>.md`` there, and rows to ``<name>.csv``."""
    print(text)
    if output is not None:
        command = typed_command()
        made = f"Made by `{command}` at {commit()} on {hardware()}."
        write_text(output / f"{name}.md", f"{made}\n\n```\n{text}\n```\n")
        if rows:
            table = output / f"{name}.csv"
            write_text(table, pd.DataFrame(rows).to_csv(index=False))
            write_origin(table, provenance() | {"command": command})
