"""The comparison of models from its command line: one command, a page, and nothing done twice by the same command."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

COMMAND = [
    *("-m", "gran_bench.train", "-m", "+experiment=models", "model=contact,gns", "seed=0,1", "tracking.sweep=models"),
    *("scene=drum_small", "dataset=small", "judge=quick", "judge.speeds_rpm=[]", "judge.short_horizon_starts=3"),
    *("scene.filling.count=120", "scene.container.length=0.2", "scene.end_time=1.8", "trainer.minutes=0.02"),
]


def test_one_command_compares_models_and_goes_on_where_it_was(tmp_path: Path):
    def compare() -> str:
        done = subprocess.run([sys.executable, *COMMAND], cwd=tmp_path, capture_output=True, encoding="utf-8")
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stderr

    page, sweep = tmp_path / "results" / "models" / "README.md", tmp_path / "results" / "sweeps" / "models"
    assert "time of a frame of 2 models and of the DEM, in turns" in compare()
    text, measured = page.read_text("utf-8"), (sweep / "side_by_side.json").read_bytes()
    for name in ("*DEM*", "`contact`", "`gns`"):
        assert f"| {name} |" in text
    assert "4 runs finished, 0 failed, 0 wait" in text
    assert (page.parent / "time_error.png").exists()
    # A run that is lost is done again; what is finished, and what was measured of the same models, is not.
    said = compare()
    assert said.count("finished before;") == 4
    assert "in turns" not in said
    assert (sweep / "side_by_side.json").read_bytes() == measured
    assert page.read_text("utf-8") == text
