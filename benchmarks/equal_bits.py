"""Whether the DEM gives, bit for bit, what an older commit gives; if so, its results keep the older code's name.

    python benchmarks/equal_bits.py OLDER_COMMIT [--keep]

Data, runs and records are named by a hash of the code that made them, so a rewriting of the fast engine puts all of
them out of date, even where it changes no bit of a trajectory. This runs both versions on the same machine, each in a
process and with a cache of kernels of its own, through scenes that reach every branch of the engine: friction and none,
rolling, sizes and materials that differ, walls of all kinds, a periodic axis, float32 contact forces, one thread and
two, skins that are narrow and wide, histories that go on from frame to frame.
Compared are positions, velocities, spins and
contact histories after every frame. With ``--keep`` and no difference, the hashes of today's code are written beside
the older ones into ``src/gran_bench/equal_code.json``, for code that differs in ``dem`` and ``neighbors`` alone.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

SOLVER = ("dem", "neighbors")
TABLE = Path("src/gran_bench/equal_code.json")
STEP = 2.0e-4  # s
HISTORY = ("first", "second", "force", "overlap", "rolling_moment")


def scenes() -> dict[str, object]:
    """Scenes of a few hundred spheres, and `drum`, by name."""
    from gran_bench.config import ContainerConfig, FillingConfig, MaterialConfig, SceneConfig, SizesConfig
    from gran_bench.scene import build_scene
    from gran_bench.shipped import shipped_scene

    made: dict[str, object] = {name: shipped_scene(name) for name in ("drum", "hopper", "packing", "free_flight")}
    kinds = {
        "one size": {},
        "frictionless": {"friction": 0.0},
        "rolling": {"rolling_friction": 0.1},
        "sizes": {"sizes": True},
        "sizes and materials": {"sizes": True, "materials": True},
        "all": {"sizes": True, "materials": True, "rolling_friction": 0.1},
    }
    for kind, choice in kinds.items():
        sizes, materials = choice.pop("sizes", False), choice.pop("materials", False)
        for periodic in (False, True):
            scene = SceneConfig(
                name="case",
                container=ContainerConfig(diameter=0.6 if sizes else 1.0, length=0.25, periodic_axis=periodic),
                filling=FillingConfig(
                    count=90 if sizes else 300,
                    sizes=SizesConfig(kind="uniform", spread=0.3) if sizes else SizesConfig(),
                    second_fraction=0.4 if materials else 0.0,
                ),
                material=MaterialConfig(**choice),
                second_material=MaterialConfig(3e6, 0.29, 4000.0, 0.5, 0.1, choice.get("rolling_friction", 0.0))
                if materials
                else None,
            )
            made[f"{kind}, {'periodic' if periodic else 'end caps'}"] = build_scene(scene).at_speed(30.0)
    made["drum"] = made["drum"].at_speed(30.0)
    return made


def digests() -> dict[str, str]:
    """Hash of everything that each run went through, by name, in this process's version."""
    from gran_bench.dem import engine_numba
    from gran_bench.dem.integrate import Physics
    from gran_bench.dem.walls import wall_poses

    found = {}
    for name, scene in scenes().items():
        variants: dict[str, dict[str, object]] = {"": {}, ", full radius": {"full_radius": True}}
        if name == "drum":
            variants |= {
                ", float32": {"single_precision": True},
                ", two threads": {"threads": 2},
                ", narrow skin": {"skin": 0.004},
                ", wide skin on two threads": {"skin": 0.05, "threads": 2},
            }
        for variant, changes in variants.items():
            physics = replace(Physics.of(scene, scene.filling.radius), **changes)
            digest, state = hashlib.sha256(), _lively(scene)
            for _ in range(8):
                state = engine_numba.advance(state, physics, STEP, wall_poses(scene, state.time, STEP, 100))
                history = state.history
                order = np.lexsort((history.second, history.first))
                for array in (
                    *(state.position, state.velocity, state.angular_velocity),
                    *(getattr(history, part)[order] + 0 for part in HISTORY),  # −0 is 0
                ):
                    digest.update(np.ascontiguousarray(array).tobytes())
            found[f"{name}{variant} ({len(history)} contacts)"] = digest.hexdigest()
    return found


def _lively(scene: object) -> object:
    """The filling with random velocities and spins, so that it touches everything soon."""
    rng, state = np.random.default_rng(1), scene.fresh_filling(0)
    shape = (state.count, 3)
    return replace(state, velocity=rng.normal(0, 1, shape), angular_velocity=rng.normal(0, 20, shape))


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


def elsewhere() -> dict[str, str]:
    """Bare code of all files that decide a result and are not the solver's, in this process's version."""
    import gran_bench
    from gran_bench.code_identity import JUDGING, MODEL_SOURCES, TRAINING, modules_behind
    from gran_bench.source_digest import bare_code

    package = Path(gran_bench.__file__).parent
    modules = modules_behind(*TRAINING, *JUDGING, *MODEL_SOURCES.values())
    files = [f"{module.replace('.', '/')}.py" for module in sorted(modules) if module.split(".")[0] not in SOLVER]
    return {file: bare_code((package / file).read_text("utf-8")) for file in files}


def told_by(source: Path, cache: Path) -> dict[str, dict[str, str]]:
    """What a process says that runs the version in a folder."""
    environment = os.environ | {"PYTHONPATH": str(source), "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, __file__, "--tell"], env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


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
        print(f"{'same bits' if equal else 'DIFFERENT':10s} {run}")
    if not all(same.values()) or len(before["digests"]) != len(same):
        print("the two versions differ; results of the older one are not results of this one")
        return 1
    print(f"{len(same)} runs, all the same as at {full}")
    changed = [file for file in after["elsewhere"] if before["elsewhere"].get(file) != after["elsewhere"][file]]
    if changed or len(before["elsewhere"]) != len(after["elsewhere"]):
        print(f"beside the solver these differ, so trainings and judgements keep hashes of their own: {changed}")
    if keep:
        names = ["solver"] if changed else list(after["hashes"])
        table = json.loads((root / TABLE).read_text("utf-8"))
        table["older"] |= {
            after["hashes"][name]: before["hashes"][name]
            for name in names
            if after["hashes"][name] != before["hashes"][name]
        }
        words = f"python benchmarks/equal_bits.py {full} --keep"
        table["shown"].append(
            {"command": words, "commit": commit(), "older": full, "runs": len(same), "hardware": hardware()}
        )
        write_text(root / TABLE, json.dumps(table, indent=2) + "\n")
        print(f"kept in {TABLE}: {', '.join(names)}")
    return 0


if __name__ == "__main__":
    if sys.argv[1:] == ["--tell"]:
        print(json.dumps({"digests": digests(), "hashes": hashes(), "elsewhere": elsewhere()}))
        sys.exit(0)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("older", help="commit to compare with")
    parser.add_argument("--keep", action="store_true", help="write the hashes of equal code")
    arguments = parser.parse_args()
    sys.exit(main(arguments.older, arguments.keep))
