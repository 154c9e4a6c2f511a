"""The record of a benchmark that the tests of its page and of the front page share."""

from __future__ import annotations

import pytest

from gran_bench.benchmark.results import FORMAT


def row(name: str, kind: str, seconds: float, floors: float | None, failure: str = "", **more) -> dict:
    ranges = {"median": seconds, "low": 0.9 * seconds, "high": 1.1 * seconds}
    ranges |= {"expected_low": 0.8 * seconds, "expected_high": 1.2 * seconds}
    found = {"name": name, "kind": kind, "unfit_because": "", "failure": failure, "failed": bool(failure)}
    found |= {"simulated_seconds": 4.0, "wall": ranges, "relative": ranges, "cpu_seconds": 0.5 * seconds}
    found |= {"peak_bytes": 2**28, "own_bytes": 2**20, "data_seconds": 0.0, "training_seconds": 0.0}
    found |= {"floors": floors, "floors_low": floors, "floors_high": floors, "by": "speed_w1", "outside": 0}
    found |= {"failed_seconds": None}
    return found | {"judgement": None} | more


@pytest.fixture
def found() -> dict:
    return {
        "format": FORMAT,
        "scene": "drum",
        "profile": "quick",
        "spheres": 3000,
        "simulated_seconds": 4.0,
        "motion": "30rpm",
        "modulus": 1e7,
        "rounds": 5,
        "automatic": "DEM 0.2 ms",
        "reference": {
            "replicas": 5,
            "noise": 1.3,
            "accepted": 1.3,
            "judged_runs": 5,
            "ranked": [{"key": "speed_w1", "label": "speeds, W1 a frame", "unit": "m/s"}],
        },
        "methods": [
            row("DEM 0.2 ms", "dem", 0.9, 1.0),
            row("DEM 1 ms", "dem", 0.2, 4.0),
            row("DEM 5 ms", "dem", 0.05, None, "sphere 3 diverged", wall=None, relative=None, failed_seconds=0.05),
            row("net", "surrogate", 0.6, 1.8, data_seconds=40.0, training_seconds=860.0),
        ],
        "waited": 0.0,
        "stiffness": {},
        "counts": {},
        "provenance": {"command": "bench", "commit": "abc", "hardware": "two cores", "versions": "numpy 2"},
    }
