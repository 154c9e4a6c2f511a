"""What matters: the swept keys that move an error or a time the furthest, everything else alike."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from gran_bench.front_page.records import Records
from gran_bench.sweep.overview import Reach, reaches

SHOWN = 2  # rows a sweep


def influence_section(records: Records, mark: Callable[[str], str]) -> Iterator[str]:
    """Lines of the section.

    Args:
        records: as read.
        mark: of a record's name: a sign where code that made it has changed since.
    """
    if not records.sweeps:
        yield "No sweep has been made yet; `python -m gran_bench.train -m +experiment=sweep_radius` is one of four."
        return
    found = [(name, reach) for name, runs in records.sweeps.items() for reach in reaches(runs)]
    single = sum(reach.one_seed for _, reach in found)
    yield (
        "The largest reaches of each sweep, everything else alike, means over seeds; those that seeds alone would "
        "exceed in one of 20 such rows (*by chance*) are left out. [All of them](sweeps/README.md)."
    )
    if single:
        yield (
            f"{single} of {len(found)} have one seed a choice and are not ranked here: nothing says what chance alone "
            "would give."
        )
    shown = [(name, reach) for name in records.sweeps for reach in largest(r for sweep, r in found if sweep == name)]
    yield ""
    if not shown:
        yield "None is left."
        return
    yield "| sweep | beside | figure | best | worst | worst / best | by chance |"
    yield "|---|---|---|---|---|---:|---:|"
    for name, reach in shown:
        best, worst = (f"{choice} ({value:.3g})" for choice, value in (reach.best, reach.worst))
        lost = f"; no figure: {', '.join(reach.lost)}" if reach.lost else ""
        cells = [f"[{name}](sweeps/{name}/README.md){mark(name)}", reach.beside, reach.figure, best, worst + lost]
        yield f"| {' | '.join([*cells, f'{reach.factor:.2f}', f'{reach.chance:.2f}'])} |"


def largest(found: Iterable[Reach]) -> list[Reach]:
    """The reaches with the largest ratio of worst to best that seeds alone do not give."""
    certain = [reach for reach in found if reach.counts]
    return sorted(certain, key=lambda reach: -reach.factor)[:SHOWN]
