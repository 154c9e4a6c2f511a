"""The main job, stage by stage: data → training → rollouts and judgement → figures → record.

Every stage leaves whole files in the run's folder and skips what is there, so the same command goes on after
any interruption and a finished run only prints its summary again.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from gran_bench import tracking
from gran_bench.atomic import locked, write_atomically, write_text
from gran_bench.config import TrainConfig
from gran_bench.dataset import Split, Windows, ensure_cases, read_case, split_cases
from gran_bench.evaluation import Evaluation, Plan, evaluate
from gran_bench.plots import draw_evaluation, loss_curves
from gran_bench.provenance import code_digest, provenance
from gran_bench.report import flat_metrics, headline, read_summary, summary_table, write_summary
from gran_bench.scene import Scene, build_scene
from gran_bench.stopping import StopRequest, stop_on_signals
from gran_bench.surrogate.build import build_model
from gran_bench.surrogate.checkpoint import ModelCard, file_digest, load_card, save_model
from gran_bench.surrogate.step import Surrogate
from gran_bench.trainer import CHECKPOINT, Trainer

MODEL = "model.pt"
TRAINING = "training.json"
LOSSES = "losses.csv"

# Sections and keys that decide where, when or how fast, but not what comes out.
_UNDECIDING = {
    "": ("experiment", "threads", "judge", "tracking"),
    "dataset": ("root", "workers", "replicas", "unseen_packing_seed", "holdout_speeds_rpm"),
    "trainer": ("minutes", "checkpoint_every", "checkpoint_steps", "log_every"),
}


def run_experiment(config: TrainConfig) -> dict[str, Any]:
    """Run the experiment that a config describes, or what is left of it.

    Args:
        config: checked.

    Returns:
        The summary, as in ``summary.json``.

    Raises:
        KeyboardInterrupt: SIGTERM or Ctrl-C; a resumable state is on disk and the MLflow run is KILLED.
    """
    scene = build_scene(config.scene)
    _tell(f"scene {scene.name}: {scene.filling.count} spheres; {scene.needs}")
    clock = Clock()
    with stop_on_signals() as stop:
        split = split_cases(scene, config.dem, config.dataset)
        with clock.stage("data"):
            _tell(f"data: {len(split.all)} cases in {Path(config.dataset.root).resolve()}")
            ensure_cases(split.all, config.dataset.root, config.dataset.workers)
            windows = training_windows(config, split)
        key = run_key(config, windows.digest)
        folder = run_folder(config, key)
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / ".lock", lambda: _tell(f"another process works on {folder}; waiting for it")):
            finished = read_summary(folder)
            if finished is not None:
                return _say_again(finished, folder)
            write_text(folder / "config.json", json.dumps(asdict(config), indent=1) + "\n")
            with tracking.open_run(
                config.tracking,
                name=folder.name,
                key=key,
                params=asdict(config),
                tags={"data_digest": windows.digest, **provenance()},
            ) as run:
                run.log_dataset(scene.name, windows.digest, str(Path(config.dataset.root).resolve()))
                summary = _run_stages(config, scene, windows, folder, run, clock, stop)
    print(summary_table(summary))
    _tell(f"figures and summary in {folder}; compare runs with `make ui`")
    return summary


def _run_stages(
    config: TrainConfig,
    scene: Scene,
    windows: Windows,
    folder: Path,
    run: tracking.Run,
    clock: Clock,
    stop: StopRequest,
) -> dict[str, Any]:
    """Train, judge, draw, record; inside an open run of the tracking store."""
    model = make_model(config, scene)
    with clock.stage("training"):
        training = train_stage(config, model, windows, folder, run, stop)
    with clock.stage("judging"):
        plan = Plan(scene, config.dem, config.dataset, config.judge)
        evaluation = evaluate(model, plan, folder, _tell)
    with clock.stage("figures"):
        _tell("figures")
        place = folder / "figures"
        figures = draw_evaluation(evaluation, plan.holdout_rpm, place, config.judge.gif, config.model.name)
        figures.append(loss_curves(pd.read_csv(folder / LOSSES), place / "loss.png"))
    summary = summarise_run(config, training, evaluation, windows.digest, folder, clock)
    for metrics in (headline(summary), flat_metrics(summary)):
        run.log_metrics(metrics, training["steps"])
    for figure in figures:
        run.log_artifact(figure, "figures")
    run.log_artifact(folder / MODEL, "model")
    path = write_summary(folder, summary)
    run.log_artifact(path)
    return summary


# ---- stages ----------------------------------------------------------------------------------------------


def training_windows(config: TrainConfig, split: Split) -> Windows:
    """The training side of the data; nothing of the held-out cases is opened."""
    cases = [read_case(spec.path(config.dataset.root)) for spec in split.training]
    trainer = config.trainer
    return Windows(cases, config.seed, trainer.startup_fraction, trainer.startup_seconds)


def make_model(config: TrainConfig, scene: Scene) -> Surrogate:
    """The model with its seeded first weights, on its device."""
    torch.manual_seed(config.seed)
    model = build_model(config.model, config.boundary, scene).to(device_of(config))
    _tell(f"model {config.model.name}: {model.parameter_count} parameters on {device_of(config)}")
    return model


def device_of(config: TrainConfig) -> str:
    """The torch device that a config asks for."""
    if config.device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return config.device


def train_stage(
    config: TrainConfig, model: Surrogate, windows: Windows, folder: Path, run: tracking.Run, stop: StopRequest
) -> dict[str, Any]:
    """Train, or load what training left; the model holds the weights to judge afterwards.

    Returns:
        What ``training.json`` says: steps, seconds, what stopped it, last loss, parameters, provenance, digest.
    """
    if (folder / TRAINING).exists():
        _, weights = load_card(folder / MODEL)
        model.load_state_dict(weights)
        return json.loads((folder / TRAINING).read_text("utf-8"))
    log = LossLog(folder / LOSSES)

    def keep(metrics: dict[str, float], step: int) -> None:
        log.add(metrics, step)
        run.log_metrics({f"training/{name}": value for name, value in metrics.items()}, step)

    trainer = Trainer(model, windows, config, folder, keep, lambda: stop.requested)
    if trainer.resume():
        log.drop_after(trainer.step)
        _tell(f"training goes on from update {trainer.step} of {config.trainer.steps} ({folder / CHECKPOINT})")
    with stop.deferred():
        result = trainer.run()
    weights = trainer.final_weights()
    model.load_state_dict(weights)
    training = asdict(result) | {"origin": provenance(), "data_digest": windows.digest}
    card = ModelCard(asdict(config.model), asdict(config.boundary), asdict(config.scene), _origin(training, config))
    training["model_sha256"] = save_model(folder / MODEL, weights, card)
    # Written last: its presence says that model and losses are whole.
    write_text(folder / TRAINING, json.dumps(training, indent=1) + "\n")
    return training


def _origin(training: dict[str, Any], config: TrainConfig) -> dict[str, Any]:
    """What a model file says about how it was made."""
    facts = {name: training[name] for name in ("steps", "seconds", "stopped_by", "data_digest")}
    return facts | {"seed": config.seed, "experiment": config.experiment, **training["origin"]}


def summarise_run(
    config: TrainConfig, training: dict[str, Any], evaluation: Evaluation, data_digest: str, folder: Path, clock: Clock
) -> dict[str, Any]:
    """Everything that ``summary.json`` says."""
    return {
        "experiment": config.experiment,
        "provenance": provenance(),
        "config": asdict(config),
        "model": asdict(config.model),
        "training": training,
        "training_data_digest": data_digest,
        "model_sha256": file_digest(folder / MODEL),
        "frame_ms": 1e3 * config.scene.frame_interval,
        "wall_seconds": clock.seconds,
        **evaluation.summary,
    }


def _say_again(summary: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A finished run prints its summary again, and says where the code has changed since."""
    print(summary_table(summary))
    _tell(f"this run was finished before; its figures and summary are in {folder}")
    if summary["provenance"]["code_digest"] != code_digest():
        _tell(f"the code has changed since; to run it anew, move {folder} away")
    return summary


# ---- what a run is called, how long it takes, what it logs -----------------------------------------------


def run_key(config: TrainConfig, data_digest: str) -> str:
    """12 hex digits of what determines the trained weights: the deciding config keys and the training data."""
    values = asdict(config)
    for section, names in _UNDECIDING.items():
        place = values[section] if section else values
        for name in names:
            del place[name]
    text = json.dumps([values, data_digest], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def run_folder(config: TrainConfig, key: str) -> Path:
    """Folder of a run: its name for people, its key for certainty."""
    name = config.tracking.folder or config.experiment
    return Path(config.tracking.root) / "runs" / f"{name}-{key[:8]}"


class Clock:
    """Wall seconds of each stage, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the block under ``name``."""
        began = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - began


class LossLog:
    """The logged losses of a training as a CSV file that survives any interruption.

    Args:
        path: of the file; rows that are there are kept.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, float]] = pd.read_csv(path).to_dict("records") if path.exists() else []

    def add(self, metrics: dict[str, float], step: int) -> None:
        """Append one row and rewrite the file whole."""
        self.rows.append({"step": step} | metrics)
        table = pd.DataFrame(self.rows)
        write_atomically(self.path, lambda file: table.to_csv(file, index=False))

    def drop_after(self, step: int) -> None:
        """Forget rows of updates that a resumed training will do again."""
        self.rows = [row for row in self.rows if row["step"] <= step]


def _tell(line: str) -> None:
    """One line of progress, on stderr, so that stdout holds the table alone."""
    print(line, file=sys.stderr, flush=True)
