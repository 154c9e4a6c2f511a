"""A finished run's page in the UI: headline figures first, what it misses, its figures, and where its files are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

from gran_bench import tracking
from gran_bench.config import EvaluateConfig, LossConfig, RolloutConfig, TrainConfig
from gran_bench.config.choices import loss_terms
from gran_bench.run.summary import (
    cut_short,
    flat_metrics,
    headline,
    judged_words,
    missed_requirements,
    registered_metrics,
    rollout_warnings,
    verdict,
)

FIGURES = "figures"
FIRST_FIGURES = ("flow_pattern.png", "angle_of_repose.png", "loss.png")  # in the description itself


def params_of(config: TrainConfig | EvaluateConfig) -> dict[str, Any]:
    """A run's parameters in the UI: its config, and in words what training minimised and how far it looked ahead."""
    # Where a run is kept differs from run to run and decides nothing: as a parameter it would head each comparison.
    params = {name: value for name, value in asdict(config).items() if name != "tracking"}
    if isinstance(config, TrainConfig):
        params |= {"loss terms": loss_in_words(config.loss), "frames ahead": rollout_in_words(config.rollout)}
    return params


def loss_in_words(loss: LossConfig) -> str:
    """The terms with their weights, 1 left out, and how the frames ahead are weighed: ``position_l2 + 0.2 spin``."""
    weights = {term: weight for term in loss_terms() if (weight := getattr(loss, term)) > 0}
    words = [" + ".join(term if weight == 1.0 else f"{weight:g} {term}" for term, weight in weights.items())]
    discounted = {"discounted": f"discounted {loss.discount:g}"}
    if loss.frame_weights != "uniform":
        words.append(discounted.get(loss.frame_weights, loss.frame_weights))
    if "spin" in weights and loss.spin_frame_weights != loss.frame_weights:
        words.append(f"spin {discounted.get(loss.spin_frame_weights, loss.spin_frame_weights)}")
    return ", ".join(words)


def rollout_in_words(rollout: RolloutConfig) -> str:
    """Frames ahead at first and at the end, and whether the gradient goes through them: ``3 to 5``."""
    words = f"{rollout.frames}"
    if rollout.final_frames not in (None, rollout.frames):
        words += f" to {rollout.final_frames}" + (", linear" if rollout.growth == "linear" else "")
    return words if rollout.gradient_through_time else f"{words}, gradient cut"


def record_judgement(run: tracking.Run, summary: dict[str, Any], folder: Path, figures: Iterable[Path]) -> None:
    """Record what the judge said in an open run: metrics, tags, figures and a description that shows them.

    Args:
        run: open.
        summary: of the run.
        folder: of the run's files.
        figures: to be kept as artifacts.
    """
    # At step 0, because the UI draws a value of a later step as a curve of one point, and else as a bar a run.
    run.log_metrics(flat_metrics(summary), 0, supersede=True)
    kept = list(figures)
    for figure in kept:
        run.log_artifact(figure, FIGURES)
    run.set_tag("model", summary["model"]["name"])
    run.set_tag("judged", judged_words(summary))
    run.set_tag("mlflow.note.content", description(summary, folder, [path.name for path in kept], run.run_id))


def description(summary: dict[str, Any], folder: Path, figures: Sequence[str], run_id: str | None) -> str:
    """A run's description in Markdown.

    Args:
        summary: of the run.
        folder: of the run's files; its name is what each figure carries.
        figures: names of the figures among the artifacts.
        run_id: in the tracking store, for links; None: without pictures.
    """
    training, found, cut = summary["training"], headline(summary), cut_short(summary["training"])
    lines = [
        f"**{summary['model']['name']}**, {training['parameters']} parameters, {training['steps']} updates; "
        f"{summary['judged_rpm']:g} rpm, {summary['judged_as']}. **{verdict(summary)}.**",
        "",
        *([f"**{cut[0].upper()}{cut[1:]}.**", ""] if cut is not None else []),
        "| figure | value |",
        "|---|---:|",
        *(f"| {name} | {found[name]:.4g} |" for name in found),
        *(f"| {name} | undefined |" for name in undefined_figures(summary)),
        "",
    ]
    for heading, rows in {
        "Not met:": missed_requirements(summary),
        "Unlike the training:": rollout_warnings(summary),
    }.items():
        lines += [heading, "", *(f"- {row}" for row in rows), ""] if rows else []
    if run_id is not None:
        quoted = {name: quote(f"{FIGURES}/{name}", safe="") for name in figures}
        places = {name: f"get-artifact?path={path}&run_uuid={run_id}" for name, path in quoted.items()}
        lines += [f"![{name}]({places[name]})\n" for name in FIRST_FIGURES if name in places]
        lines.append(f"All figures: {', '.join(f'[{name}]({place})' for name, place in places.items())}.")
    lines += ["", f"Files: `{folder.as_posix()}`. Each figure carries the name `{folder.name}`."]
    return "\n".join(lines)


def undefined_figures(summary: dict[str, Any]) -> list[str]:
    """Names of the headline figures that have no value, because what they measure does not exist in this run."""
    found, registered = headline(summary), registered_metrics(summary["judged"]["shared"])
    return [name for name in (*tracking.HEADLINE_FIGURES, *registered) if name not in found]
