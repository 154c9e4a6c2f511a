"""The emulator's job, stage by stage: runs of the DEM → training → judging beside rivals → figures → record."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from gran_bench import tracking
from gran_bench.config import TrainConfig
from gran_bench.emulator import judging
from gran_bench.emulator.network import Emulator
from gran_bench.emulator.rivals import rivals
from gran_bench.emulator.runs import ensure_runs, read_run
from gran_bench.emulator.training import TrainingRuns, make_emulator
from gran_bench.plots.emulator import emulated_schedules
from gran_bench.plots.style import drawn_for
from gran_bench.plots.training import loss_curves
from gran_bench.processes import StopRequest, stop_on_signals, tell
from gran_bench.provenance import provenance
from gran_bench.run.cost import emulator_cost
from gran_bench.run.identity import EmulatorPlan, emulator_plan, identify, wants_more
from gran_bench.run.record import LOSSES, Clock, RunRecord
from gran_bench.run.summary import FIGURES, finished_summary, record_judgement

Train = Callable[[TrainConfig, Emulator, TrainingRuns, Path, tracking.Run, StopRequest], dict[str, Any]]


def run_emulator(config: TrainConfig, train: Train) -> dict[str, Any]:
    """Run the emulator's experiment, or what is left of it; gives the summary, as in ``summary.json``.

    ``train`` is the stage that every model is trained by. Arguments and errors else as of `run_experiment`.
    """
    plan, clock, data = emulator_plan(config), Clock(), config.dataset
    record = RunRecord(identify(config), config, plan.scene.name, clock)
    with stop_on_signals() as stop:
        left = int(finished_summary(record.identity) is None)
        if emulator_cost(config, plan.training, plan.replicas, left).tell(config.dry_run):
            return {}

        def work(run: tracking.Run) -> dict[str, Any]:
            with clock.stage("data"):
                tell(f"runs of the DEM under {len(plan.training)} schedules; their statistics are kept")
                ensure_runs(plan.training, data.root, data.workers)
                runs = TrainingRuns(
                    plan.training, [read_run(spec, data.root) for spec in plan.training], config.model.batch
                )
            emulator = make_emulator(config, plan.scene, runs.figures)
            tell(f"model emulator: {emulator.parameter_count} parameters, {len(runs.series)} runs")
            with clock.stage("training"):
                training = train(config, emulator, runs, record.identity.folder, run, stop)
            return _judge_stage(record, emulator.eval(), plan, runs, training, run)

        return record.carry_out(work, lambda finished: wants_more(config, finished["training"]))


def _judge_stage(
    record: RunRecord, emulator: Emulator, plan: EmulatorPlan, data: TrainingRuns, training: dict[str, Any],
    run: tracking.Run,
) -> dict[str, Any]:  # fmt: skip
    """Judge, draw and record; returns the summary."""
    config, folder, root = record.config, record.identity.folder, record.config.dataset.root
    with record.clock.stage("judging"):
        tell(f"replicas of the DEM under {len(plan.judged)} schedules to judge against")
        ensure_runs(plan.replicas, root, config.dataset.workers)
        runs = judging.judge_schedules(emulator, plan.judged, rivals(data), root, tell)
        own, dem = judging.emulator_seconds(emulator, runs[0]), judging.dem_rivals(runs[0], root)
    with record.clock.stage("figures"), drawn_for(folder.name):
        figures = [emulated_schedules(runs, folder / FIGURES / "schedules.png")]
        if (folder / LOSSES).exists():
            figures.append(loss_curves(pd.read_csv(folder / LOSSES), folder / FIGURES / "loss.png"))
    judged_as = "validation" if config.dataset.validation_speeds_rpm else "held out"
    summary = judging.summary_of(runs, own, dem, emulator, judged_as) | {
        "experiment": training["experiment"],
        "provenance": provenance(),
        "model": asdict(config.model),
        "training": training,
        "frame_ms": 1e3 * plan.scene.frame_interval,
        "wall_seconds": record.clock.seconds,
        "data_digest": data.digest,
    }
    record_judgement(run, summary, folder, figures)
    return summary
