"""The main job, stage by stage: data → training → rollouts and judgement → figures → record.

Every stage leaves whole files in the run's folder and skips what is there, so the same command goes on after
any interruption and a finished run only prints its summary again.
"""

import json
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from gran_bench import tracking
from gran_bench.config import EmulatorConfig, EvaluateConfig, SceneConfig, TrainConfig
from gran_bench.config.reading import read_config, validate
from gran_bench.dataset import Windows, ensure_cases
from gran_bench.emulator.network import Emulator
from gran_bench.emulator.training import EmulatorTrainer, TrainingRuns
from gran_bench.evaluation import evaluate
from gran_bench.evaluation.plan import Plan
from gran_bench.files import write_text
from gran_bench.plots.evaluation import draw_evaluation
from gran_bench.plots.style import drawn_for, titled
from gran_bench.plots.training import VALIDATION, loss_curves
from gran_bench.processes import StopRequest, stop_on_signals, tell
from gran_bench.provenance import provenance
from gran_bench.provenance.source_digest import model_code
from gran_bench.run.cost import Cost, data_cost, flow_cost, judging_cost, training_cost
from gran_bench.run.emulation import run_emulator
from gran_bench.run.going_on import go_on, parent_of, updates_ahead
from gran_bench.run.identity import RunIdentity, hash_of, identify, judged_by, judging_plan, splits, wants_more
from gran_bench.run.pace import rollout_pace
from gran_bench.run.record import LOSSES, MODEL, TRAINING, Clock, LossLog, RunRecord, training_metrics
from gran_bench.run.start_from import Start, refuse_unfair, seen_elsewhere, start_of, trained_on
from gran_bench.run.summary import FIGURES, cut_short, finished_summary, record_judgement, training_words
from gran_bench.scene import build_scene
from gran_bench.surrogate.checkpoint import (
    CheckpointError,
    ModelCard,
    file_digest,
    load_card,
    load_model,
    read_tensors,
    save_model,
)
from gran_bench.surrogate.contact.compiling import compile_kernels, kernels_missing
from gran_bench.surrogate.step import Surrogate
from gran_bench.trainer import CHECKPOINT, Trainer, TrainingStopped
from gran_bench.trainer.start import device_named, make_model, training_windows, validation_windows
from gran_bench.trainer.validation import Validation


def run_experiment(config: TrainConfig) -> dict[str, Any]:
    """Run the experiment that a config describes, or what is left of it; gives the summary, as in ``summary.json``.

    What it will take is told first; with ``dry_run`` that is all, and the summary is empty.

    Raises:
        ConfigError: a value that no run can have.
        KeyboardInterrupt: SIGTERM or Ctrl-C; a resumable state is on disk and the MLflow run is KILLED.
    """
    validate(config)
    if isinstance(config.model, EmulatorConfig):
        return run_emulator(config, train_stage)
    scene, clock, split, start = build_scene(config.scene), Clock(), splits(config), start_of(config)
    model = make_model(config, scene)
    if start is not None:
        tell(f"starts from the weights of {start.name}")
        for line in start.put_into(model, config):
            tell(f"warning: {start.given}: {line}")
    with stop_on_signals() as stop:
        # A sweep has told the cost of its jobs, and measured it while no other job ran.
        if config.tracking.parent is None and experiment_cost(config).tell(config.dry_run):
            return {}
        with clock.stage("data"):
            ensure_cases(split.all, config.dataset.root, config.dataset.workers)
            windows = training_windows(config, split)
        record, plan = RunRecord(identify(config), config, scene.name, clock), judging_plan(config)

        def work(run: tracking.Run) -> dict[str, Any]:
            compile_ahead(config.model.name)
            device = next(model.parameters()).device
            tell(f"model {config.model.name}: {model.parameter_count} parameters on {device}")
            with clock.stage("training"):
                go_on(config, record.identity)
                seen = validation_windows(config, split)
                beside = None if seen is None else Validation(model, seen, config.loss)
                training = train_stage(config, model, windows, record.identity.folder, run, stop, start, beside)
            return judge_stage(record, model, plan, asdict(config.model), training, run)

        return record.carry_out(work, lambda finished: wants_more(config, finished["training"]))


def run_evaluation(config: EvaluateConfig) -> dict[str, Any]:
    """Roll out and judge a model file, without training; gives the summary, which is empty with ``dry_run``.

    Raises:
        CheckpointError: the file is no model.
        ConfigError: a value that cannot be, or a speed that the model was trained on.
        KeyboardInterrupt: as for `run_experiment`.
    """
    validate(config)
    path = Path(config.checkpoint)
    model, card = load_model(path, device_named(config.device))
    scene, name = build_scene(read_config(SceneConfig, card.scene)), card.model["name"]
    tell(f"model {name}: {model.parameter_count} parameters from {path}, made for scene {scene.name}")
    refuse_unfair(config, card.origin, "this model")
    compile_ahead(name)
    plan = Plan(scene, config.dem, config.dataset, config.judge)
    key = hash_of(file_digest(path), judged_by(plan), model_code(name))
    folder = Path(config.tracking.root) / "evaluations" / f"{path.resolve().parent.name}-{key[:8]}"
    identity = RunIdentity(folder, key, judged_by(plan), card.origin["data_digest"])
    record = RunRecord(identity, config, scene.name, Clock())
    if finished_summary(identity) is None or config.dry_run:
        cost = flow_cost(scene, config.dem)
        cost += data_cost(scene, config.dem, plan.cases, config.dataset.root, config.dataset.workers)
        if (cost + judging_cost(plan, rollout_pace(model, scene))).tell(config.dry_run):
            return {}

    def work(run: tracking.Run) -> dict[str, Any]:
        return judge_stage(record, model, plan, card.model, card.origin, run)

    with stop_on_signals():
        return record.carry_out(work, lambda finished: False)


def experiment_cost(config: TrainConfig) -> Cost:
    """What is left to do of an experiment, and what it will take."""
    scene, data, split, plan = build_scene(config.scene), config.dataset, splits(config), judging_plan(config)
    cost = flow_cost(scene, config.dem)
    cost += data_cost(scene, config.dem, [*split.all, *plan.cases], data.root, data.workers)
    done: int | None = 0
    if all(spec.path(data.root).exists() for spec in split.training):
        identity = identify(config)
        training, checkpoint = identity.folder / TRAINING, identity.folder / CHECKPOINT
        if training.exists() and not wants_more(config, json.loads(training.read_text("utf-8"))):
            if finished_summary(identity) is not None:
                return cost
            done = None
        elif checkpoint.exists():
            with suppress(CheckpointError, OSError):  # the training says what is wrong with it
                done = read_tensors(checkpoint, "cpu")["step"]
        else:
            done = updates_ahead(config, identity)
    compile_ahead(config.model.name)
    return cost + training_cost(config, plan, split.training, done)


def compile_ahead(model: str) -> None:
    """Compile what a model needs and this installation has not, in a process of its own."""
    if kernels_missing(model):
        tell("compiling the kernels of the network (once, a minute or two) …")
        compile_kernels(model)


def train_stage(
    config: TrainConfig, model: Surrogate | Emulator, windows: Windows | TrainingRuns, folder: Path, run: tracking.Run,
    stop: StopRequest,
    start: Start | None = None, validation: Validation | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Train, or load what training left, into the model; gives what ``training.json`` says."""
    if (folder / TRAINING).exists():
        training = json.loads((folder / TRAINING).read_text("utf-8"))
        if not wants_more(config, training):
            model.load_state_dict(load_card(folder / MODEL)[1])
            return training
        (folder / TRAINING).unlink()
    log = LossLog(folder / LOSSES)

    def keep(metrics: dict[str, float], step: int) -> None:
        if validation is not None:
            metrics = metrics | {VALIDATION: validation.loss(int(metrics["frames_ahead"]))}
        log.add(metrics, step)
        run.log_metrics(training_metrics(metrics), step)

    make = EmulatorTrainer if isinstance(windows, TrainingRuns) else Trainer
    trainer = make(model, windows, config, folder, keep, lambda: stop.requested, tell)
    if trainer.resume():
        tell(f"training goes on from update {trainer.step} of {config.trainer.steps} ({folder / CHECKPOINT})")
    log.drop_after(trainer.step)
    for row in log.rows:  # what the store missed when the process was killed
        run.log_metrics(training_metrics(row), int(row["step"]))
    try:
        with stop.deferred():
            result = asdict(trainer.run())
    except TrainingStopped as stopped:
        tell(str(stopped))
        raise KeyboardInterrupt(stop.signal_name) from None
    if (cut := cut_short(result)) is not None:
        tell(cut)
    weights = trainer.final_weights()
    model.load_state_dict(weights)
    training = result | {
        "seed": config.seed,
        "experiment": config.experiment,
        **trained_on(config),
        "data_digest": windows.digest,
        **({"figures": windows.figures} if isinstance(windows, TrainingRuns) else {}),
        "data_seconds": windows.data_seconds,
        **seen_elsewhere(config),
        **({} if start is None else start.record(config)),
        **parent_of(folder),
        **provenance(),
    }
    card = ModelCard(asdict(config.model), asdict(config.boundary), asdict(config.scene), training)
    training["model_sha256"] = save_model(folder / MODEL, weights, card)
    run.log_artifact(folder / MODEL, "model")
    # Written last: its presence says that model and losses are whole.
    write_text(folder / TRAINING, json.dumps(training, indent=1, allow_nan=False) + "\n")
    return training


def judge_stage(
    record: RunRecord, model: Surrogate, plan: Plan, card: dict[str, Any], training: dict[str, Any], run: tracking.Run
) -> dict[str, Any]:
    """Roll out, judge, draw and record; returns the summary."""
    config, folder = record.config, record.identity.folder
    with record.clock.stage("judging"):
        evaluation = evaluate(model, plan, folder, tell)
    with record.clock.stage("figures"), drawn_for(folder.name):
        tell("figures")
        place = folder / FIGURES
        figures = draw_evaluation(evaluation, plan.judged_rpm, place, config.judge.gif, card["name"])
        if (folder / LOSSES).exists():
            with titled(f"{record.scene_name}, {training_words(training)}"):
                figures.append(loss_curves(pd.read_csv(folder / LOSSES), place / "loss.png"))
    summary = {
        "experiment": training["experiment"],
        "provenance": provenance(),
        "model": card,
        "training": training,
        "frame_ms": 1e3 * plan.scene.frame_interval,
        "wall_seconds": record.clock.seconds,
        **evaluation.summary,
    }
    record_judgement(run, summary, folder, figures)
    return summary
