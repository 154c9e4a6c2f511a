"""Whether the DEM gives, bit for bit, what an older commit gives; if so, its results keep the older code's name.

    python benchmarks/equal_bits.py OLDER_COMMIT [--keep]

Data, runs and records are named by a hash of the code that made them, so a rewriting of the fast engine puts all of
them out of date, even where it changes no bit of a trajectory. This runs both versions on the same machine, each in a
process and with a cache of kernels of its own, through scenes that use all its parts (equal_bits_runs.py), and compares
positions, velocities, spins and contact histories bit by bit. With ``--keep`` and no difference, the hashes of today's
code are written beside the older ones into ``src/gran_bench/equal_code.json``. That is refused where a file differs
that these runs do not speak for: scenes, time steps, checks.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

TABLE = Path("src/gran_bench/equal_code.json")
# Files that the runs speak for; any other of these rooms must be the same.
ROOMS = ("dem", "neighbors", "scene")
COMPARED = {
    *("dem/barrier.py", "dem/bodies.py", "dem/compile_beside.py", "dem/compile_lists.py", "dem/compiling.py"),
    *("dem/contact.py", "dem/contact_blocks.py", "dem/contact_list.py", "dem/engine_numba.py", "dem/engine_numpy.py"),
    *("dem/frame.py", "dem/integrate.py", "dem/kernel.py", "dem/prediction.py", "dem/rows.py", "dem/seams.py"),
    *("dem/search.py", "dem/stretch.py", "dem/wall_contacts.py", "dem/wall_list.py"),
    *("neighbors/cells.py", "neighbors/kernel.py", "neighbors/lanes.py", "neighbors/tree.py", "scene/sizes.py"),
}


def hashes() -> dict[str, str]:
    """The hashes that data, trainings and judgements are named by, in this process's version."""
    from gran_bench.code_identity import JUDGING, MODEL_SOURCES, TRAINING, modules_behind
    from gran_bench.source_digest import source_digest

    def behind(*roots: str) -> str:
        return source_digest(f"{module.replace('.', '/')}.py" for module in sorted(modules_behind(*roots)))

    return {
        "solver": source_digest(("dem", "neighbors", "scene")),
        "judging": behind(*JUDGING),
        **{f"training {model}": behind(*TRAINING, source) for model, source in MODEL_SOURCES.items()},
    }


def others() -> dict[str, str]:
    """Bare code of all files that decide a result and that the runs do not speak for, in this process's version."""
    import gran_bench
    from gran_bench.code_identity import JUDGING, MODEL_SOURCES, TRAINING, modules_behind
    from gran_bench.source_digest import bare_code

    package = Path(gran_bench.__file__).parent
    files = {
        f"{module.replace('.', '/')}.py" for module in modules_behind(*TRAINING, *JUDGING, *MODEL_SOURCES.values())
    }
    files |= {path.relative_to(package).as_posix() for room in ROOMS for path in (package / room).rglob("*.py")}
    return {file: bare_code((package / file).read_text("utf-8")) for file in sorted(files - COMPARED)}


def told_by(source: Path, cache: Path) -> dict[str, dict[str, str]]:
    """What a process says that runs the version in a folder."""
    environment = os.environ | {"PYTHONPATH": str(source), "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, __file__, "--tell"], env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    told = json.loads(done.stdout.splitlines()[-1])
    if Path(told["package"]).resolve().parents[1] != source.resolve():
        raise SystemExit(f"{told['package']} was imported where {source} was asked for")
    return told


def main(older: str, keep: bool) -> int:
    """Compares, prints, and keeps what it found."""
    from gran_bench.atomic import write_text
    from gran_bench.provenance import commit, hardware

    root = Path(__file__).resolve().parents[1]
    full = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "--short=12", older], check=True, capture_output=True, text=True
    ).stdout.strip()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        archive = subprocess.run(["git", "-C", str(root), "archive", full, "src"], check=True, capture_output=True)
        with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as tar:
            tar.extractall(folder / "older", filter="data")
        before = told_by(folder / "older" / "src", folder / "cache_older")
        after = told_by(root / "src", folder / "cache")
    same = {run: before["digests"].get(run) == digest for run, digest in after["digests"].items()}
    for run, equal in same.items():
        if not equal:
            print(f"DIFFERENT: {run}")
    if not all(same.values()) or len(before["digests"]) != len(same):
        print("the two versions differ; results of the older one are not results of this one")
        return 1
    print(f"{len(same)} runs, all the same as at {full}")
    files = before["others"].keys() | after["others"].keys()
    changed = sorted(file for file in files if before["others"].get(file) != after["others"].get(file))
    if changed:
        print(f"these runs do not speak for files that differ too: {', '.join(changed)}")
        return 1
    if keep:
        lines = {
            after["hashes"][name]: hash_before
            for name, hash_before in before["hashes"].items()
            if after["hashes"][name] != hash_before
        }
        table = json.loads((root / TABLE).read_text("utf-8"))
        table["older"] |= lines
        table["shown"].append(
            {
                "command": f"python benchmarks/equal_bits.py {full} --keep",
                "commit": commit(),
                "hardware": hardware(),
                "runs": len(same),
                "older": sorted(lines),
            }
        )
        write_text(root / TABLE, json.dumps(table, indent=2) + "\n")
        print(f"kept in {TABLE}: {', '.join(after['hashes'])}")
    return 0


if __name__ == "__main__":
    if sys.argv[1:] == ["--tell"]:
        from equal_bits_runs import digests

        import gran_bench

        told = {"digests": digests(), "hashes": hashes(), "others": others(), "package": gran_bench.__file__}
        print(json.dumps(told))
        sys.exit(0)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("older", help="commit to compare with")
    parser.add_argument("--keep", action="store_true", help="write the hashes of equal code")
    arguments = parser.parse_args()
    sys.exit(main(arguments.older, arguments.keep))
