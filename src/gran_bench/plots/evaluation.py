"""All figures of an evaluated model."""

from __future__ import annotations

from pathlib import Path

from gran_bench.evaluation import Evaluation
from gran_bench.evaluation.plan import rollout_name
from gran_bench.plots.angle import angle_of_repose
from gran_bench.plots.animation import flow_animation
from gran_bench.plots.depth import speed_by_depth
from gran_bench.plots.diagnostics import diagnostics
from gran_bench.plots.flow_pattern import flow_pattern
from gran_bench.plots.nearest import nearest_cases
from gran_bench.plots.position_error import position_error
from gran_bench.plots.speeds import speed_distribution


def draw_evaluation(
    evaluation: Evaluation, holdout_rpm: float, folder: Path | str, gif: bool = True, model_name: str = "surrogate"
) -> list[Path]:
    """Draw the paper's figures of the held-out speed, from the shared and from the unseen packing.

    Args:
        evaluation: of one model.
        holdout_rpm: the held-out speed.
        folder: for the files; those of the unseen packing end in ``_unseen``.
        gif: whether to make the film of both flows, too (shared packing).
        model_name: for the legends.

    Returns:
        The paths, those of the paper's figures first.
    """
    folder, paths = Path(folder), []
    for packing, replicas in evaluation.replicas.items():
        unseen = packing == "unseen"
        name, suffix = rollout_name(holdout_rpm, unseen), "_unseen" if unseen else ""
        case, rollout = evaluation.cases[name], evaluation.rollouts[name].trajectory
        candidate = {model_name: evaluation.candidates[packing]}
        runs = {"DEM": case.trajectory, model_name: rollout}
        paths += [
            flow_pattern(runs, case.scene, folder / f"flow_pattern{suffix}.png"),
            angle_of_repose(candidate, replicas, folder / f"angle_of_repose{suffix}.png"),
            speed_distribution(candidate, replicas, folder / f"speed_distribution{suffix}.png"),
            position_error(candidate, replicas, folder / f"position_error{suffix}.png"),
            speed_by_depth(candidate, replicas, folder / f"speed_by_depth{suffix}.png"),
            diagnostics(candidate, replicas, folder / f"diagnostics{suffix}.png"),
        ]
        if gif and not unseen:
            paths.append(flow_animation(runs, case.scene, folder / "flow.gif"))
    paths.append(nearest_cases(_distances(evaluation), folder / "nearest_case.png"))
    return paths


def _distances(evaluation: Evaluation) -> dict[float, dict[float, float | None]]:
    """Speed W1 of each rollout (by its speed) from each case (by its speed), m/s."""
    rows = evaluation.summary["nearest_case"].values()
    speeds = {rollout_name(row["own_rpm"]): row["own_rpm"] for row in rows}
    return {row["own_rpm"]: {speeds[name]: value for name, value in row["w1_m_s"].items()} for row in rows}
