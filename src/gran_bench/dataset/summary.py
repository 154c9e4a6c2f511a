"""A data set in a table: what each case is, what it cost, how fast it flows."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gran_bench.config import GenerateConfig
from gran_bench.dataset.case_file import read_attributes, read_case
from gran_bench.dataset.case_spec import DatasetError, Split, dem_source_hash, own_case, rotation_label
from gran_bench.dataset.ensure import ensure_cases
from gran_bench.dataset.imported import ENGINE, split_cases
from gran_bench.scene import build_scene

STEADY_AFTER = 2.0  # s after the start of the rotation


@dataclass(frozen=True)
class CaseRow:
    """One line of the table.

    Attributes:
        label: speed of the case.
        side: ``training``, ``validation`` or ``holdout``; – where a scene makes one case.
        particles: N.
        frames: F.
        time_step: s.
        steady_speed: mean instantaneous speed over particles and the frames from 2 s after the start on, m/s;
            None where the run is shorter or the rotation is not constant.
        wall_seconds: what the case cost, its settled bed not included, s.
        megabytes: size of the file, 10⁶ bytes.
        path: the file.
    """

    label: str
    side: str
    particles: int
    frames: int
    time_step: float
    steady_speed: float | None
    wall_seconds: float
    megabytes: float
    path: Path


def generate(config: GenerateConfig) -> list[Path]:
    """Make the cases of a data set, print their table, and return their files.

    Raises:
        SceneError: a scene that cannot exist.
        DatasetError: a case that cannot be made, or a damaged file.
    """
    scene = build_scene(config.scene)
    root = config.dataset.root
    print(f"scene {scene.name}: {scene.needs}")
    if scene.takes_speeds:
        split = split_cases(scene, config.dem, config.dataset)
        specs = split.all
    else:
        split, specs = None, [own_case(scene, config.dem, config.dataset)]
        print("it keeps its own motion, so it makes one case; dataset.*_speeds_rpm are not read")
    paths = ensure_cases(specs, root, config.dataset.workers)
    print(table(case_rows(split, root) if split else [_row(paths[0], "–")]))
    for path in paths:
        for warning in read_attributes(path)["warnings"].splitlines():
            print(f"warning, {path.name}: {warning}")
    beds = {spec.settled_path(root) for spec in specs}
    for path in sorted(path for path in beds if path.exists()):
        print(f"settled bed {path}: {read_attributes(path)['wall_seconds']:.1f} s")
    if old := files_of_older_code(root):
        size = sum(path.stat().st_size for path in old) / 1e6
        print(f"{len(old)} files ({size:.0f} MB) are of older solver code and not used any more, such as {old[0]}")
    return paths


def files_of_older_code(root: Path | str) -> list[Path]:
    """Whole files under ``root`` that other code of the solver made, so that nothing reads them any more."""
    found = []
    for path in sorted(Path(root).rglob("*.h5")):
        with suppress(DatasetError):
            facts = read_attributes(path)
            if facts["engine"] != ENGINE and facts["dem_code"] != dem_source_hash():
                found.append(path)
    return found


def case_rows(split: Split, root: Path | str) -> list[CaseRow]:
    """The table of a data set that has been made."""
    sides = {id(spec): side for side in ("training", "validation", "holdout") for spec in getattr(split, side)}
    return [_row(spec.path(root), sides[id(spec)]) for spec in split.all]


def _row(path: Path, side: str) -> CaseRow:
    case = read_case(path)
    scene, motion = case.scene, case.trajectory
    steady = motion.time >= scene.start_time + STEADY_AFTER - 0.5 * scene.frame_interval
    speed = None
    if scene.takes_speeds and steady.any() and case.settled.count:
        speed = float(np.linalg.norm(motion.velocity[steady], axis=2).mean(dtype=np.float64))
    return CaseRow(
        label=rotation_label(scene),
        side=side,
        particles=case.settled.count,
        frames=motion.frame_count,
        time_step=float(case.attributes["time_step"]),
        steady_speed=speed,
        wall_seconds=float(case.attributes["wall_seconds"]),
        megabytes=path.stat().st_size / 1e6,
        path=path,
    )


def table(rows: Sequence[CaseRow]) -> str:
    """The rows as aligned text."""
    head = ("case", "split", "N", "frames", "step, µs", "steady speed, m/s", "wall time, s", "MB", "file")
    lines = [head] + [
        (
            row.label,
            row.side,
            f"{row.particles}",
            f"{row.frames}",
            f"{1e6 * row.time_step:.0f}",
            "–" if row.steady_speed is None else f"{row.steady_speed:.3f}",
            f"{row.wall_seconds:.1f}",
            f"{row.megabytes:.1f}",
            str(row.path),
        )
        for row in rows
    ]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)
