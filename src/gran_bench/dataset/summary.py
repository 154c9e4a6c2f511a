"""A data set in a table: what each case is, what it cost, how fast it flows."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from gran_bench.config import GenerateConfig
from gran_bench.dataset.case_file import read_attributes, read_case
from gran_bench.dataset.case_spec import CaseSpec, DatasetError, dem_source_hash, has_splits, own_case, rotation_label
from gran_bench.dataset.ensure import ensure_cases
from gran_bench.dataset.imported import ENGINE, split_cases
from gran_bench.dem.energy_balance import EnergyBalance
from gran_bench.scene import build_scene

HEAD = ("case", "split", "N", "frames", "step, µs", "late speed, m/s", "wall time, s", "MB", "file")


def generate(config: GenerateConfig) -> list[Path]:
    """Make the cases of a data set, print their table, and return their files.

    Raises:
        SceneError: a scene that cannot exist.
        DatasetError: a case that cannot be made, or a damaged file.
    """
    scene = build_scene(config.scene)
    root = config.dataset.root
    print(f"scene {scene.name}: {scene.spheres}; {scene.needs}")
    if has_splits(scene, config.dataset):
        split = split_cases(scene, config.dem, config.dataset)
        sides = {id(spec): side for side in ("training", "validation", "holdout") for spec in getattr(split, side)}
        specs = split.all
    else:
        specs, sides = [own_case(scene, config.dem, config.dataset)], {}
        print("it keeps its own motion, so it makes one case; dataset.*_speeds_rpm are not read")
    paths = ensure_cases(specs, root, config.dataset.workers)
    print(
        _table([HEAD, *(_row(spec, path, sides.get(id(spec), "–")) for spec, path in zip(specs, paths, strict=True))])
    )
    for spec, path in zip(specs, paths, strict=True):
        if spec.dem.power:
            print(f"energy, {path.name}: {power_words(path)}")
        for warning in read_attributes(path)["warnings"].splitlines():
            print(f"warning, {path.name}: {warning}")
    beds = {spec.settled_path(root) for spec in specs}
    for path in sorted(path for path in beds if path.exists()):
        print(f"settled bed {path}: {read_attributes(path)['wall_seconds']:.1f} s")
    if old := _files_of_older_code(root):
        size = sum(path.stat().st_size for path in old) / 1e6
        print(f"{len(old)} files ({size:.0f} MB) are of older solver code and not used any more, such as {old[0]}")
    return paths


def power_words(path: Path) -> str:
    """The mean power of a case over the later half of its frames, and where it goes, in W."""
    motion = read_case(path).trajectory
    since = float(motion.time[max(0, motion.frame_count // 2 - 1)])
    found = EnergyBalance.of(motion).figures(since)
    if not found:
        return "no frame"
    power = found.pop("power_W")
    terms = {name.removesuffix("_W").replace("_", " "): value for name, value in found.items() if name != "loss_W"}
    told = ", ".join(f"{name} {value:.3g} W" for name, value in terms.items() if value)
    return f"from {since:g} s on the walls give {power:.4g} W: {told}"


def _files_of_older_code(root: Path | str) -> list[Path]:
    """Whole files under ``root`` that other code of the solver made, so that nothing reads them any more."""
    found = []
    for path in sorted(Path(root).rglob("*.h5")):
        with suppress(DatasetError):
            facts = read_attributes(path)
            if facts["engine"] != ENGINE and facts["dem_code"] != dem_source_hash():
                found.append(path)
    return found


def _row(spec: CaseSpec, path: Path, side: str) -> tuple[str, ...]:
    """A case's cells; its late speed is the mean over spheres and the later half of the frames, – without rotation."""
    case = read_case(path)
    scene, motion = case.scene, case.trajectory
    late, speed = motion.velocity[motion.frame_count // 2 :], "–"
    if scene.takes_speeds and case.settled.count:
        speed = f"{np.linalg.norm(late, axis=2).mean(dtype=np.float64):.3f}"
    step, seconds = case.attributes["time_step"], case.attributes["wall_seconds"]
    numbers = f"{case.settled.count}", f"{motion.frame_count}", f"{1e6 * step:.0f}", speed, f"{seconds:.1f}"
    motion = rotation_label(spec.scene) + f", packing {spec.packing_seed}" * (not scene.takes_speeds)
    return motion, side, *numbers, f"{path.stat().st_size / 1e6:.1f}", str(path)


def _table(lines: list[tuple[str, ...]]) -> str:
    """Lines of cells as aligned text."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)
