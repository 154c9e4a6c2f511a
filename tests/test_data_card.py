"""The data card: a figure of each case, drawn once, and tables that say what is undefined."""

from pathlib import Path

import pytest

from gran_bench.config import ContainerConfig, DatasetConfig, FillingConfig, GenerateConfig, RotationConfig, SceneConfig
from gran_bench.dataset import CaseSpec, ensure_case, generate
from gran_bench.plots.data_card import draw_missing_cards, print_data_card
from gran_bench.scene import build_scene


def config(root: Path, **dataset: object) -> GenerateConfig:
    """Two speeds of a tiny drum, one below and one above its critical speed of 66 rpm."""
    scene = SceneConfig(
        name="drum_tiny",
        container=ContainerConfig(diameter=0.4, length=0.2),
        filling=FillingConfig(count=40),
        rotation=RotationConfig(times=[0.4], speeds_rpm=[30.0]),
        start_time=0.4,
        end_time=0.6,
    )
    speeds = {"training_speeds_rpm": [100.0], "holdout_speeds_rpm": [30.0]} | dataset
    return GenerateConfig(scene=scene, dataset=DatasetConfig(root=str(root), replicas=2, workers=1, **speeds))


def test_each_case_is_drawn_once_beside_its_file(tmp_path: Path):
    path = ensure_case(CaseSpec(build_scene(config(tmp_path).scene)), tmp_path)
    (figure,) = draw_missing_cards([path])
    assert figure == tmp_path / "figures" / f"{path.stem}.png"
    assert figure.read_bytes().startswith(b"\x89PNG")
    drawn = figure.stat().st_mtime_ns
    assert draw_missing_cards([path]) == [figure]
    assert figure.stat().st_mtime_ns == drawn


def test_generating_prints_a_table_of_the_cases(tmp_path: Path, capsys: pytest.CaptureFixture):
    paths = generate(config(tmp_path))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("scene drum_tiny: 40 spheres of 50 mm; needs tangential")
    assert lines[1].split()[:4] == ["case", "split", "N", "frames"]
    assert lines[2].split()[:5] == ["30rpm", "holdout", "40", "21", "200"]
    assert lines[3].split()[:5] == ["100rpm", "training", "40", "21", "200"]
    assert 0.0 < float(lines[2].split()[5]) < float(lines[3].split()[5]), "mean speeds of the later half"
    assert lines[2].split()[-1] == str(paths[0])
    assert lines[4].startswith("settled bed")


def test_generating_tells_of_files_that_older_code_made(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    with monkeypatch.context() as older:
        older.setattr("gran_bench.dataset.case_spec.dem_source_hash", lambda: "older")
        older.setattr("gran_bench.dataset.generation.dem_source_hash", lambda: "older")
        ensure_case(CaseSpec(build_scene(config(tmp_path).scene)), tmp_path)
    (tmp_path / "damaged.h5").write_bytes(b"no HDF5")
    generate(config(tmp_path))
    assert "2 files (0 MB) are of older solver code and not used any more" in capsys.readouterr().out


def test_the_cards_tables_say_what_is_undefined(tmp_path: Path, capsys: pytest.CaptureFixture):
    print_data_card(config(tmp_path))
    cases, floors = capsys.readouterr().out.split("\n\n")
    below, above = cases.splitlines()[2:]
    assert below.startswith("| 30rpm | undefined |"), "no steady angle without a steady part"
    assert above.startswith("| 100rpm | undefined | undefined |"), "no angle above the critical speed"
    speeds = next(line for line in floors.splitlines() if "speeds, W1 a frame" in line)
    assert all(float(cell) > 0 for cell in speeds.strip("| ").split(" | ")[1:])
