"""All scenes of the benchmark together: families, who is on the frontiers, and the picture."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import benchmark_records
import pytest
from benchmark_records import row

from gran_bench.benchmark import overview
from gran_bench.benchmark.page import write_page
from gran_bench.benchmark.results import RESULTS

found = benchmark_records.found


@pytest.mark.parametrize(
    ("name", "kind", "family"),
    [
        ("DEM 0.2 ms", "dem", "dem"),
        ("DEM 0.4 ms, float32", "dem", "float32"),
        ("DEM 1.25 ms, E = 1e6 Pa", "dem", "softened"),
        ("DEM 0.3 ms, coarse-grained 1.5", "dem", "coarse"),
        ("net", "surrogate", "surrogate"),
        ("stat", "emulator", "emulator"),
        ("interpolation, 25 and 35 rpm", "baseline", "interpolation"),
        ("rigid rotation", "baseline", "baseline"),
    ],
)
def test_a_method_is_of_a_family_by_its_name_and_kind(name, kind, family):
    assert overview.family_of({"name": name, "kind": kind}) == family


def keep(root: Path, found: dict, *scenes: str) -> None:
    for scene in scenes:
        (root / "quick" / scene).mkdir(parents=True)
        (root / "quick" / scene / RESULTS).write_text(json.dumps(copy.deepcopy(found) | {"scene": scene}))


def test_all_scenes_are_drawn_with_statistics_apart_and_the_ladder_in_order(found, tmp_path, monkeypatch):
    claim = {"a": {"label": "a", "multiple": 1.1}, "b": {"label": "b", "multiple": 1.6}}
    found["methods"] += [
        row("DEM 0.3 ms, coarse-grained 1.26", "dem", 0.1, 1.1),
        row("stat", "emulator", 0.01, None, statistics=claim),
        row("rigid rotation", "baseline", 0.01, 75.0),
    ]
    keep(tmp_path, found, "drum", "drum_low")
    drawn = []
    monkeypatch.setattr(overview, "overview", lambda panels, path: drawn.extend(panels) or path)
    overview.draw_overview(tmp_path)
    assert [panel.title for panel in drawn] == ["drum, 3000 spheres", "drum_low, 3000 spheres"]
    points = {(point.family, point.seconds, point.error, point.factor) for point in drawn[0].points}
    assert points == {
        *(("dem", 0.9, 1.0, None), ("dem", 0.2, 4.0, None), ("surrogate", 0.6, 1.8, None)),
        *(("coarse", 0.1, 1.1, 1.26), ("emulator", 0.01, 1.6, None)),
    }
    monkeypatch.undo()
    assert overview.draw_overview(tmp_path).stat().st_size > 10_000
    assert f"]({overview.FIGURE})" in write_page(tmp_path).read_text("utf-8")


def test_one_scene_has_no_picture_of_all(found, tmp_path):
    keep(tmp_path, found, "drum")
    assert overview.draw_overview(tmp_path) is None
    page = write_page(tmp_path).read_text("utf-8")
    assert overview.FIGURE not in page
    assert page.startswith("# Run time against error\n\n<!-- overview -->\n**On the frontier, where ")


def test_the_words_count_scenes_by_family_and_say_where_the_surrogate_stands(found):
    beaten = copy.deepcopy(found)
    beaten["methods"].append(row("DEM 0.3 ms, coarse-grained 1.5", "dem", 0.3, 0.9))
    text = overview.overview_text(Path("nowhere"), {"quick/a": found, "quick/b": beaten})
    assert text.startswith("**On the frontier, where nothing is both faster and as exact, stands the DEM at one of ")
    assert "of its steps in 2 of 2 scenes, " in text
    assert "a coarse-grained DEM in 1, a surrogate in 1.**" in text
    said = "The surrogate net fits 2 of the scenes: a DEM that is as exact is faster in 1 (2 times), it is faster than "
    assert said + "every DEM as exact in 1." in text
