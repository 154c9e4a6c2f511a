"""The front page as text: a pure function of the committed records, but for what stands between the marks of `age`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gran_bench.atomic import write_text
from gran_bench.front_page.accuracy import accuracy_section
from gran_bench.front_page.advice import advice_section
from gran_bench.front_page.age import STALE, Age, AgeOf, age_of, today
from gran_bench.front_page.failures import failure_section
from gran_bench.front_page.in_short import in_short
from gran_bench.front_page.influence import influence_section
from gran_bench.front_page.records import Origin, Records, read_records
from gran_bench.front_page.speed import speed_section

PAGE = "README.md"
SECTIONS = {
    "How accurate": accuracy_section,
    "How fast, against what": speed_section,
    "What failed": failure_section,
    "When not to use a surrogate": advice_section,
    "What matters": influence_section,
}
# Page, what it is, command; in the order of the table.
PAGES = (
    (
        "holdout30rpm/README.md",
        "the default model at a speed that it never saw; `model.pt` to try without training",
        "`make train`",
    ),
    (
        "benchmark/README.md",
        "every method on the same scene, in turns: run time against error, who wins at equal accuracy, what pays",
        "`make bench`; in full `python -m gran_bench.benchmark -m profile=full scene=drum,packing`",
    ),
    (
        "benchmark/two_runs.md",
        "two runs of it: times and errors beside what each expects of the other",
        "`python benchmarks/two_benchmarks.py`, as its first lines say",
    ),
    (
        "verification/README.md",
        "the DEM against theory and published experiments, point by point",
        "`python -m data_gen.verify`",
    ),
    (
        "verification/drum_flow.md",
        "steady flow in the drum beside LAMMPS, packing by packing",
        "`python benchmarks/drum_flow.py`, as the page says",
    ),
    (
        "verification/drum_flow_1e8.md",
        "the same with stiffer spheres, where a difference between the codes' laws vanishes",
        "`python benchmarks/drum_flow.py`, as the page says",
    ),
    (
        "stress/README.md",
        "where the DEM, a surrogate, files and processes break; each expectation was written beforehand",
        "`make stress`",
    ),
    (
        "dem_speed/README.md",
        "the DEM beside LAMMPS; its cost against the number of spheres; what each skip saves",
        "`make bench-kernels`, and as the page says",
    ),
    (
        "sweeps/README.md",
        "what matters and by how much, over the four sweeps that ship",
        "`python -m gran_bench.train -m +experiment=sweep_radius hydra/launcher=local` and the like",
    ),
    (
        "paper/README.md",
        "the article's network and training, two hours on two CPU cores",
        "`python -m gran_bench.train +experiment=paper`",
    ),
)
YOURS = """\
A sweep of your own is in `results/sweeps/`, which git ignores but for the four that ship (`sweep_loss`,
`sweep_rollout`, `sweep_radius`, `sweep_boundary`): of those it takes tables, figures and a small file a run.
`python -m gran_bench.report` makes tables and figures anew from the small files, and this page from the records that
are committed.

A run of your own is in `results/runs/`, which git ignores, like the database and the artifacts of `make ui`. To make a
page of it: `python -m gran_bench.result_page results/runs/NAME results/NAME`."""


def write_front_page(root: Path) -> Path | None:
    """Write the front page of a results folder, whole or not at all; None where it has no record.

    Raises:
        ResultsError, SweepFileError, ValueError: a record that cannot be read.
    """
    records = read_records(root)
    if not records.found:
        return None
    write_text(root / PAGE, page_text(records, root))
    return root / PAGE


def page_text(records: Records, root: Path, age: AgeOf = age_of) -> str:
    """The page.

    Args:
        records: as read.
        root: results folder; of it, which pages are there.
        age: of a record.
    """
    ages = {origin: age(origin) for origin in records.origins}
    stale = {origin.record for origin, found in ages.items() if found.stale}

    def mark(record: str) -> str:
        return today(f" {STALE}" if record in stale else "")

    lines = ["# Results", "", *in_short(records), ""]
    lines += ["Made by `python -m gran_bench.report` from the committed records; each section links to its pages."]
    lines += [today(_warning(stale)), ""]
    for title, section in SECTIONS.items():
        lines += [f"## {title}", "", *section(records, mark)]
        lines += [] if lines[-1] == "" else [""]
    lines += ["## Where the figures come from", "", *_origins(ages), "", "## Pages", "", *_pages(root), "", YOURS]
    return "\n".join(lines) + "\n"


def _warning(stale: set[str]) -> str:
    """A paragraph that names what is older than the code; empty where nothing is."""
    if not stale:
        return ""
    return (
        f"\n{STALE} are the records {', '.join(sorted(stale))}: code that made them has changed since, so a new run "
        "may say something else. What changed is said [below](#where-the-figures-come-from)."
    )


def _origins(ages: dict[Origin, Age]) -> Iterator[str]:
    yield "| record | command | commit | hardware | day of the commit; code that has changed since |"
    yield "|---|---|---|---|---|"
    for origin, age in ages.items():
        name = f"[{origin.record}]({origin.page})" + (f", {origin.note}" if origin.note else "")
        made = (f"`{origin.command}`", f"`{origin.commit}`", origin.hardware)
        cells = made if origin.commit else ("nothing says so beside the record", "", "")
        yield f"| {name} | {' | '.join(cells)} | {today(str(age))} |"


def _pages(root: Path) -> Iterator[str]:
    yield "| page | what it is | command |"
    yield "|---|---|---|"
    for page, what, command in PAGES:
        name = page.removesuffix("/README.md").removesuffix(".md")
        there = (root / page).exists()
        link, rest = (f"[{name}]({page})", "") if there else (name, "; **not made yet**")
        yield f"| {link} | {what}{rest} | {command} |"
