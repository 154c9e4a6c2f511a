"""What the page of a benchmark says of its results, with what failed and what is undecided."""

from __future__ import annotations

import copy
import json
import math
import re
from types import SimpleNamespace

import benchmark_records
import pytest
from benchmark_records import row

from gran_bench.benchmark import command
from gran_bench.benchmark.page import part_text, surrogate_rows, table_of, winner
from gran_bench.benchmark.results import (
    FORMAT,
    RESULTS,
    ResultsError,
    entries,
    judged_anew,
    read_all,
    read_results,
    share_waited,
    untimed,
)

found = benchmark_records.found


class Replicas:
    """What a kept result is told anew with: floors, errors of the replicas, and the noise."""

    ranked = ()
    own = {"speed_w1": [0.9, 1.0, 1.1]}  # noqa: RUF012
    floor = SimpleNamespace(between="packings")

    def __init__(self, floor: float = 0.02) -> None:
        self._floor = floor

    def floors(self, spheres=None) -> dict[str, float]:
        return {"speed_w1": self._floor}

    def noise(self, runs: int) -> float:
        return 1.0 + 1.0 / runs


def test_kept_results_are_told_anew_without_measuring(found):
    errors = {"speed_w1": {"floor": 0.02, "value": 0.02, "unit": "m/s", "multiple_of_floor": 1.0}}
    found["methods"][0]["judgement"] = {"velocity_kind": "instantaneous", "errors": errors}
    anew = judged_anew(found, Replicas(), 3)
    assert anew["reference"]["accepted"] == anew["reference"]["noise"] == 1.2
    assert anew["methods"] == found["methods"]
    assert anew["reference"]["floor_between"] == "packings"
    with pytest.raises(ResultsError, match="other replicas"):
        judged_anew(found, Replicas(floor=0.03), 3)
    found["reference"]["ranked"].append({"key": "center_height"})
    with pytest.raises(ResultsError, match="ranked by center_height, speed_w1, and now by speed_w1"):
        judged_anew(found, Replicas(), 3)


def test_statistics_have_a_table_of_their_own_and_no_place_in_the_ranking(found):
    claim = {"label": "speeds, W1 a frame", "multiple": 1.62, "mean_error": 1.04, "spread": 0.0}
    found["methods"].append(row("interpolation, 25 and 35 rpm", "baseline", 1e-4, None, statistics={"speed_w1": claim}))
    beyond = "spheres 1500, trained at 3000 ± 10 %"
    said = {"statistics": {"speed_w1": claim}, "beyond": beyond, "training_seconds": 60.0}
    found["methods"].append(row("stat", "emulator", 1e-2, None, **said))
    text = part_text("quick/drum", found)
    assert f"stat goes beyond what it learned: {beyond}." in text
    cells = ("interpolation, 25 and 35 rpm", "0.0001", "0", "0", "speeds, W1 a frame", "1.04", "1.62", "0.00")
    assert re.search(r"\| " + r" +\| ".join(map(re.escape, cells)), text)
    assert text.count("| interpolation") == 1
    assert "interpolation" not in winner(found)
    assert not any(entry.name.startswith(("interpolation", "stat")) for entry in entries(found))
    assert table_of(found)["speed_w1_energy_score"].tolist()[-1] == 1.62
    assert table_of(found)["beyond"].tolist()[-1] == beyond


def test_a_coarse_grained_dem_says_over_how_many_packings_its_error_is(found):
    found["methods"].append(row("DEM 0.3 ms, coarse-grained 1.5", "dem", 0.1, 1.1, packings=3))
    assert "| **DEM 0.3 ms, coarse-grained 1.5**, 3 packings |" in part_text("quick/drum", found)
    assert table_of(found)["packings"].tolist() == [1, 1, 1, 1, 3]


def test_the_first_sentences_say_who_is_on_the_frontier_and_where_the_surrogate_stands(found):
    said = part_text("quick/drum", found)
    assert said.startswith("On the frontier, where nothing is both faster and as exact: DEM 1 ms, net and DEM 0.2 ms. ")
    assert "The surrogate net (0.6 s, 1.80 floors): at equal accuracy the surrogate is 1.5 times as fast." in said
    found["methods"].append(row("DEM 0.3 ms", "dem", 0.1, 0.9))
    assert part_text("quick/drum", found).startswith("On the frontier, where nothing is both faster and as exact: DEM ")
    assert "net" not in part_text("quick/drum", found).partition(". The")[0]


def test_a_floor_between_packings_is_told(found):
    assert "between packings" not in part_text("quick/drum", found)
    found["reference"]["floor_between"] = "packings"
    assert "one floor is the distance between packings" in part_text("quick/drum", found)


def test_the_worst_of_three_errors_is_named_as_such(found):
    found["reference"]["ranked"] = [{"key": key, "label": key, "unit": "-"} for key in ("a", "b", "c")]
    assert "Error: the worst of a, b and c. The DEM's own" in part_text("quick/drum", found)


def test_results_that_were_never_measured_cannot_be_told_anew(tmp_path):
    with pytest.raises(ResultsError, match="measure=true"):
        read_results(tmp_path / RESULTS)


def test_too_few_replicas_leave_the_winner_unknown(found):
    found["reference"] |= {"replicas": 2, "noise": None, "accepted": None}
    text = part_text("quick/drum", found)
    assert "own accuracy: undefined, 2 replicas do not give the DEM's own accuracy; three or more do" in text
    assert "Who wins is not known" in text
    assert "| net | the surrogate is 1.5 times as fast | DEM 0.2 ms (" in text


def test_the_page_says_who_wins_and_marks_who_failed(found):
    text = part_text("quick/drum", found)
    assert "Fastest of the DEM's own accuracy (1.30 floors): DEM 0.2 ms (0.9 s" in text
    assert "- ✗ DEM 5 ms failed: sphere 3 diverged" in text
    assert "| **net** | 0.6 (0.48 to 0.72) | 0.6 | 1.80 (1.80 to 1.80) |" in text
    (line,) = [line for line in text.splitlines() if line.startswith("| net |")]
    assert "| the surrogate is 1.5 times as fast | DEM 0.2 ms (0.9 s, 1.00 floors): × 1.5 (1.2 to 1.8) |" in line
    assert line.endswith("| DEM 1 ms (0.2 s, 4.00 floors) | 40 | 860 | 3,000 |")


def test_a_dem_that_is_as_exact_and_faster_wins_and_training_is_never_paid_back(found):
    found["methods"].append(row("DEM 1.25 ms, E = 1e6 Pa", "dem", 0.3, 1.2))
    assert "floors): DEM 1.25 ms, E = 1e6 Pa (" in winner(found)
    (said,) = surrogate_rows(found)
    assert said[1] == "DEM 1.25 ms, E = 1e6 Pa is 2 times as fast"
    assert said[-1] == "never"
    table = table_of(found).set_index("method")
    assert table.loc["net", "break_even_seconds"] == math.inf
    assert not table.loc["net", "on_frontier"]
    assert table.loc["DEM 5 ms", "failed"]


def test_intervals_that_allow_both_answers_leave_the_page_undecided(found):
    found["methods"].append(row("DEM 1.5 ms", "dem", 0.3, 1.9, floors_low=1.7, floors_high=2.1))
    next(one for one in found["methods"] if one["name"] == "net").update(floors_low=1.5, floors_high=2.1)
    ((_, who, beside, *_, paid),) = surrogate_rows(found)
    assert (who, paid) == ("undecided", "undecided")
    assert beside.startswith("DEM 0.2 ms (0.9 s, 1.00 floors): × 1.5 (1.2 to 1.8); DEM 1.5 ms (")
    assert beside.endswith(": × 0.5 (0.41 to 0.61)")
    assert math.isnan(table_of(found).set_index("method").loc["net", "break_even_seconds"])


def test_the_winner_is_everyone_whose_time_is_not_told_apart(found):
    found["methods"].append(row("DEM 0.25 ms", "dem", 0.85, 1.2))
    said = "not told apart: DEM 0.25 ms (0.85 s, 1.20 floors); DEM 0.2 ms (0.9 s"
    assert said in winner(found)


def test_the_winner_names_who_is_faster_and_may_be_as_exact(found):
    found["methods"].append(row("DEM 0.5 ms", "dem", 0.4, 1.4, floors_low=1.2, floors_high=1.6))
    assert "Faster and perhaps of that accuracy" in winner(found)
    assert "DEM 0.5 ms (0.4 s, 1.40 floors) (1.20 to 1.60)" in winner(found)


def test_interpolation_alone_is_said_to_have_no_spheres(found):
    found["methods"].append(row("interpolation, 25 and 35 rpm", "baseline", 1e-4, 1.1, data_seconds=40.0))
    said = winner(found)
    assert "after 40 s of data, statistics without spheres). Fastest DEM of that accuracy: DEM 0.2 ms (" in said
    found["methods"][-1] |= {"name": "rigid rotation", "data_seconds": 0.0}
    assert "statistics" not in winner(found)
    assert "of data" not in winner(found)


def test_the_page_says_where_a_surrogate_starts_to_cost_less(found):
    def points(**costs):
        return [{"at": float(at[1:]), "wall": {"median": cost}, "failure": ""} for at, cost in costs.items()]

    found["stiffness"] = {
        "automatic": points(_1e7=0.3, _1e9=3.0),
        "largest": points(_1e7=0.1, _1e9=0.4),
        "net": points(_1e7=0.6),
    }
    found["counts"] = {"DEM": points(_300=0.1, _3000=1.0), "net": points(_300=0.2, _3000=0.5)}
    text = part_text("quick/drum", found)
    assert "| net | 0.6 | from E = 4.0e+07 Pa on | at no stiffness that was timed |" in text
    assert "Errors were measured at E = 1.0e+07 Pa alone" in text
    assert "| × the DEM | 300 spheres | 3000 spheres |" in text
    assert "| net | 2 | 0.5 |" in text
    assert text.count("✗") == 1


def test_points_of_a_study_that_failed_are_said_and_drawn(found, tmp_path, monkeypatch):
    def point(at: float, cost: float | None, failure: str = "") -> dict:
        return {"at": at, "wall": None if cost is None else {"median": cost}, "failure": failure}

    found["stiffness"] = {
        "automatic": [point(1e7, 0.3), point(1e9, None, "sphere 3 diverged")],
        "largest": [point(1e7, 0.1), point(1e9, 0.4, "sphere 4 diverged")],
        "net": [point(1e7, None, "not finite")],
    }
    found["counts"] = {"DEM": [point(300, 0.1)], "net": [point(300, None, "not finite")]}
    text = part_text("quick/drum", found)
    assert "✗ DEM, automatic step failed at E = 1.0e+09 Pa: sphere 3 diverged" in text
    assert "✗ DEM, largest allowed step failed at E = 1.0e+09 Pa: sphere 4 diverged" in text
    assert "✗ net failed at E = 1.0e+07 Pa: not finite" in text
    assert "✗ net failed at 300 spheres: not finite" in text
    drawn = []
    monkeypatch.setattr(command, "cost_against", lambda lines, *_: drawn.extend(lines))
    command.draw(found, tmp_path)
    assert [list(line.failed_at) for line in drawn] == [[1e9], [1e9], [1e7], [], [300]]
    monkeypatch.undo()
    command.draw(found, tmp_path)


def test_a_run_that_failed_on_its_way_has_a_place_in_the_figure(found):
    (failed,) = [one for one in entries(found) if one.floors is None]
    assert (failed.name, failed.seconds) == ("DEM 5 ms", 0.05)


def test_a_run_that_failed_before_its_first_frame_is_named_in_the_figure(found, tmp_path, monkeypatch):
    seen = {}
    monkeypatch.setattr(command, "time_against_error", lambda *given: seen.update(timed=given[0], lost=given[-1]))
    nothing = {"wall": None, "relative": None}
    found["methods"].append(row("DEM 9 ms", "dem", 0.05, None, "sphere 3 diverged", **nothing))
    assert untimed(found) == ["DEM 9 ms"]
    command.draw(found, tmp_path)
    assert ([one.name for one in seen["timed"]], seen["lost"]) == (["0.2 ms", "1 ms", "5 ms", "net"], ["9 ms"])


def test_a_benchmark_of_failures_alone_is_drawn(found, tmp_path):
    nothing = {"wall": None, "relative": None}
    found["methods"] = [row("DEM 0.2 ms", "dem", 0.05, None, "sphere 3 diverged", **nothing)]
    command.draw(found, tmp_path)
    assert (tmp_path / "time_error.png").exists()
    assert "No method has the DEM's own accuracy" in part_text("quick/drum", found)


def test_methods_that_waited_for_the_processor_say_that_the_machine_was_busy(found):
    assert share_waited(found["methods"]) == pytest.approx(0.5)
    found["waited"] = 0.5
    for said in (part_text("quick/drum", found), command.summary(found)):
        assert "Methods waited 50 % of their time for the processor" in said


def test_full_results_of_a_scene_stand_for_it(found, tmp_path):
    for place in ("quick/drum", "full/drum", "quick/packing"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / RESULTS).write_text(json.dumps(copy.deepcopy(found)))
    assert list(read_all(tmp_path)) == ["full/drum", "quick/packing"]
    (tmp_path / "quick/packing" / RESULTS).write_text(json.dumps(found | {"format": FORMAT - 1}))
    with pytest.raises(ResultsError, match="another version"):
        read_all(tmp_path)
