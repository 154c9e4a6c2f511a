"""What a finished run says: ``summary.json`` for machines, a table and a page in the UI for people."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

from gran_bench import tracking
from gran_bench.config import EvaluateConfig, LossConfig, RolloutConfig, TrainConfig
from gran_bench.config.choices import loss_terms
from gran_bench.config.registry import METRICS
from gran_bench.emulator.runs import COMPARED
from gran_bench.emulator.runs import FIGURES as EMULATED
from gran_bench.evaluation.plan import motion_words, packing_words, rollout_name
from gran_bench.files import write_text
from gran_bench.metrics.judgement import shown_multiple
from gran_bench.metrics.outside import FailureCount, counted
from gran_bench.metrics.requirements import ANGLES, SPEEDS, WITHOUT_ANGLE
from gran_bench.run.identity import RunIdentity
from gran_bench.tracking.search import SUMMARY

FIGURES = "figures"
FIRST_FIGURES = ("flow_pattern.png", "angle_of_repose.png", "purpose.png", "loss.png")  # in the description itself

_HEADLINE_ERRORS = {  # name and unit in MLflow
    "surface_angle": ("angle error", "deg"),
    "com_angle": ("com angle error", "deg"),
    "center_height": ("height error", "m"),
    "discharge_rate": ("discharge rate error", "kg per s"),
    "packing_fraction": ("packing fraction error", "share"),
    "speed_w1": ("speed W1", "m per s"),
}


def write_summary(folder: Path, summary: dict[str, Any]) -> Path:
    """Write ``summary.json``, whole or not at all; its presence says that the run is finished."""
    path = folder / SUMMARY
    write_text(path, json.dumps(summary, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    return path


def read_summary(folder: Path) -> dict[str, Any] | None:
    """The summary of a finished run, or None."""
    path = folder / SUMMARY
    return json.loads(path.read_text("utf-8")) if path.exists() else None


def finished_summary(identity: RunIdentity) -> dict[str, Any] | None:
    """The summary of a run that is finished and judged as it would be now, else None."""
    summary = read_summary(identity.folder)
    return summary if summary is not None and summary["judged_by"] == identity.judged_by else None


def judged_words(summary: Mapping[str, Any]) -> str:
    """On which speed a run was judged: ``validation, 35 rpm``."""
    return f"{summary['judged_as']}, {motion_words(summary['judged_rpm'])}"


def judged_tags(judged: str, missed: float) -> dict[str, str]:
    """A judged run's first columns in the UI, of `judged_words` and how many requirements are not met."""
    kind, _, speed = judged.rpartition(", ")
    return {"speed": f"{speed}, {kind}", tracking.VERDICT: "fail" if missed else "pass"}


def headline(summary: Mapping[str, Any]) -> dict[str, float]:
    """The figures that a person looks at first, by their names in MLflow; one that is undefined is absent."""
    shared, last = summary["judged"]["shared"], summary["position_error"]["10_frames"]["m"]
    found = {}
    for key in ranked_errors(shared):
        row, (name, unit) = shared["errors"][key], _HEADLINE_ERRORS[key]
        found |= {f"{name} {unit}": row["value"], f"{name} floors": row["multiple_of_floor"]}
    found |= {
        "position error 10 frames mm": None if last is None else 1e3 * last,
        "rollout ms per frame": summary["rollouts"][rollout_name(summary["judged_rpm"])]["ms_per_frame_median"],
        "training minutes": summary["training"]["seconds"] / 60.0,
        "requirements failed": len(missed_requirements(summary)),
        "rollouts failed": len(broken_rollouts(summary)),
    }
    for name in registered_metrics(shared):
        found[name], row = shared["figures"][name]["value"], shared["errors"][name]
        found |= {f"{name} error": row["value"], f"{name} floors": row["multiple_of_floor"]}
    return {name: float(value) for name, value in found.items() if value is not None}


def ranked_errors(judged: Mapping[str, Any]) -> list[str]:
    """The distances of a judgement that a method is ranked by; where the DEM has no angle, what the scene is for."""
    errors, rows = judged["errors"], ANGLES
    known = [key for key in WITHOUT_ANGLE if errors.get(key, {}).get("floor") is not None]
    if known and not any(errors[key]["floor"] is not None for key in ANGLES):
        rows = known
    return [*rows, SPEEDS]


def compared_errors(summary: Mapping[str, Any]) -> list[str]:
    """Those that the baselines of a run have, too."""
    rows = summary["baselines"].values()
    return [key for key in ranked_errors(summary["judged"]["shared"]) if all(key in row for row in rows)]


def registered_metrics(judged: Mapping[str, Any]) -> list[str]:
    """The metrics of plugins that a judgement has."""
    return [name for name in METRICS.added() if name in judged["errors"]]


def missed_requirements(summary: Mapping[str, Any]) -> list[str]:
    """A line for each requirement that is not met: judged ones, speeds not told apart, rollouts that broke down."""
    missed = [
        f"{row['label']}: {_figure(row)} ({packing_words(packing, summary['judged_rpm'])})"
        for packing, judged in summary["judged"].items()
        for row in judged["requirements"].values()
        if row["verdict"] == "fail"
    ]
    for name, row in summary["nearest_case"].items():
        if not row["is_own"]:
            nearest = "nothing" if row["nearest_rpm"] is None else f"{row['nearest_rpm']:g} rpm"
            missed.append(f"rolled out at {name}, nearest to {nearest}")
    return missed + [f"rollout {name} broke down at frame {k}" for name, k in broken_rollouts(summary).items()]


def requirements_met(summary: Mapping[str, Any]) -> dict[str, tuple[int, int]]:
    """How many requirements are met, and of how many, by the part of the table that lists them; none is undefined."""
    parts = {
        packing_words(packing, summary["judged_rpm"]): [row["verdict"] == "pass" for row in rows]
        for packing, judged in summary["judged"].items()
        if (rows := [row for row in judged["requirements"].values() if row["verdict"] != "undefined"])
    }
    parts["tells speeds apart"] = [row["is_own"] for row in summary["nearest_case"].values()]
    parts["rollouts"] = [row["failed_frame"] is None for row in summary["rollouts"].values()]
    return {name: (sum(met), len(met)) for name, met in parts.items() if met}


def broken_rollouts(summary: Mapping[str, Any]) -> dict[str, int]:
    """The frame at which each rollout that broke down did so, by the rollout's name."""
    frames = {name: row["failed_frame"] for name, row in summary["rollouts"].items()}
    return {name: frame for name, frame in frames.items() if frame is not None}


def rollout_warnings(summary: Mapping[str, Any]) -> list[str]:
    """A line for each difference between a rollout and the training of its model."""
    rollouts = summary["rollouts"].items()
    return [f"rollout {name} is an extrapolation: {line}" for name, row in rollouts for line in row.get("warnings", ())]


def flat_metrics(summary: Mapping[str, Any]) -> dict[str, float]:
    """Every defined figure of a summary for the tracking store, as ``headline/name`` or ``packing/kind/name``."""
    metrics: dict[str, Any] = {tracking.HEADLINE + name: value for name, value in headline(summary).items()}
    for packing, judged in summary["judged"].items():
        for name, row in judged["errors"].items():
            metrics[f"{packing}/error/{name}"] = row["value"]
            metrics[f"{packing}/floors/{name}"] = row["multiple_of_floor"]
        metrics |= {f"{packing}/figure/{name}": row["value"] for name, row in judged["figures"].items()}
        metrics |= {f"{packing}/failures/{name}": count for name, count in (judged["failures"] or {}).items()}
    metrics |= {f"nearest/{name}": row["nearest_rpm"] for name, row in summary["nearest_case"].items()}
    metrics |= {f"position_error/{name}": row["m"] for name, row in summary["position_error"].items()}
    for name, row in summary["rollouts"].items():
        metrics[f"rollout/{name}/ms_per_frame"] = row["ms_per_frame_median"]
        metrics[f"rollout/{name}/dem_ms_per_frame"] = row["dem_ms_per_frame"]
        metrics |= {f"dem_energy/{name}/{term}": value for term, value in row.get("dem_energy", {}).items()}
    for packing, table in summary.get("statistics", {}).get("averages", {}).items():
        for name, row in table.items():
            metrics |= {f"{packing}/{key}/{name}": row[key] for key in ("ratio", "spread", "energy", "energy_of_runs")}
    metrics |= {f"wall_seconds/{name}": seconds for name, seconds in summary["wall_seconds"].items()}
    numbers = {name: value for name, value in metrics.items() if isinstance(value, int | float)}
    return {name: float(value) for name, value in numbers.items() if not isinstance(value, bool)}


def cut_short(training: Mapping[str, Any]) -> str | None:
    """A sentence that says that the clock has cut the steps of a training, as in ``training.json``, or None."""
    steps, planned = training["steps"], training.get("planned_steps")
    if planned is None or steps >= planned:
        return None
    return (
        f"the clock has cut the training: {steps} of {planned} updates in {training['seconds'] / 60.0:.1f} minutes, "
        f"the last at a learning rate of {training['learning_rate']:.2g}; with more trainer.minutes the same command "
        "goes on"
    )


def training_words(training: Mapping[str, Any]) -> str:
    """What a model was trained on, as ``training.json`` says it: ``trained at 20, 25 rpm, packing 0``."""
    if packings := training.get("training_packings"):
        return f"trained on packings {', '.join(map(str, packings))}"
    speeds = ", ".join(f"{rpm:g}" for rpm in training["training_speeds_rpm"])
    return f"trained at {speeds} rpm, packing {training['packing_seed']}"


def descent(training: Mapping[str, Any]) -> str | None:
    """From which run a training went on, or whose weights it started from; ``training.json`` says it. Else None."""
    if (parent := training.get("parent_run")) is None:
        return None
    steps = training.get("parent_steps")
    return f"starts from the weights of {parent}" if steps is None else f"goes on from update {steps} of {parent}"


def summary_table(summary: Mapping[str, Any]) -> str:
    """The end of the terminal output: requirements met and missed, headline figures, where things are."""
    return "\n".join(_lines(summary))


def _lines(summary: Mapping[str, Any]) -> Iterator[str]:
    training, rpm = summary["training"], summary["judged_rpm"]
    yield f"{summary['experiment']}: {summary['model']['name']}, {training['parameters']} parameters"
    minutes = training["seconds"] / 60
    yield f"trained {training['steps']} updates in {minutes:.1f} min (stopped by {training['stopped_by']})"
    yield from (line for line in (descent(training), cut_short(training)) if line is not None)
    for packing, judged in summary["judged"].items():
        head = f"{motion_words(rpm)}, {summary['judged_as']}, {packing_words(packing, rpm)}"
        yield from ("", head, _row("", "found", "verdict"))
        for row in judged["requirements"].values():
            yield _row(row["label"], _figure(row), f"{row['verdict']}{_note(row)}")
        if judged.get("phases"):
            yield f"  the DEM's flow: {judged['phases']['label']}"
        yield _row("distance from the DEM", "found", "noise floor")
        for name in (*ranked_errors(judged), *registered_metrics(judged)):
            row = judged["errors"][name]
            times = "" if row["multiple_of_floor"] is None else f" (× {shown_multiple(row['multiple_of_floor'])})"
            yield _row(row["label"], _figure(row), f"{_figure(row, 'floor')}{times}{_note(row)}")
        if judged["failures"]:
            yield from (f"  {line}" for line in FailureCount(**judged["failures"]).lines(judged.get("dem_outside")))
        # Figures that a further run of the DEM would not have (95 %); no requirement is about them.
        unlike = [row for row in judged["figures"].values() if row["inside_interval"] is False]
        if unlike:
            yield _row("outside the interval of the DEM (95 %), no requirement", "found", "DEM")
        for row in unlike:
            low, high = (_figure({"value": end, "unit": row["unit"]}) for end in row["dem_interval"])
            yield _row(row["label"], _figure(row), f"{low} … {high}")
    if statistics := summary.get("statistics"):
        yield from ("", *statistics_lines(statistics), *_rollout_lines(summary), "", verdict(summary))
        return
    ranked = [key for key in compared_errors(summary) if key != "com_angle"]
    yield from ("", f"baselines, {motion_words(rpm)}, {packing_words('shared', rpm)}")
    heads = [_HEADLINE_ERRORS[key][0].removesuffix(" error") for key in ranked]
    yield f"  {'':<56}" + "".join(f"{head:>17}" for head in heads) + f"{'a frame':>12}"
    for name, errors in summary["baselines"].items():
        time = _figure(errors | {"unit": "ms"}, "ms_per_frame") if "ms_per_frame" in errors else "not timed"
        yield f"  {name:<56}" + "".join(f"{_figure(errors[key]):>17}" for key in ranked) + f"{time:>12}"
    if summary["nearest_case"]:
        yield from ("", "tells speeds apart (the one DEM run at each speed that is nearest, by speed W1)")
    alone = "  [the only speed, so there is none to be told from]" if len(summary["nearest_case"]) == 1 else ""
    for name, row in summary["nearest_case"].items():
        nearest = "undefined" if row["nearest_rpm"] is None else f"{row['nearest_rpm']:g} rpm"
        yield _row(name, nearest, f"{'pass' if row['is_own'] else 'fail'}{alone}")
    yield from _rollout_lines(summary)
    yield from (f"  {line}" for line in rollout_warnings(summary))
    shown = ", ".join(_figure(row | {"unit": "m"}, "m") for row in summary["position_error"].values())
    horizons = ", ".join(name.split("_")[0] for name in summary["position_error"])
    yield from ("", f"position error after {horizons} frames: {shown}")
    rollout = summary["rollouts"][rollout_name(rpm)] | {"unit": "ms"}
    own, dem = (_figure(rollout, key) for key in ("ms_per_frame_median", "dem_ms_per_frame"))
    yield (
        f"time for a frame of {summary['frame_ms']:g} ms: surrogate {own}, this DEM {dem} (one core; other work on the "
        "machine counts)"
    )
    yield f"wall time: {', '.join(f'{name} {seconds:.0f} s' for name, seconds in summary['wall_seconds'].items())}"
    yield from ("", verdict(summary))


def _rollout_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    broken = broken_rollouts(summary)
    yield from ("", "rollouts")
    for name in summary["rollouts"]:
        found, last = (f"failed at frame {broken[name]}", "fail") if name in broken else ("to the end", "pass")
        yield _row(f"rollout {name}", found, last)


def statistics_lines(found: Mapping[str, Any]) -> Iterator[str]:
    """A table of the ``statistics`` of a summary: every schedule, the averages and the rivals, for people."""
    heading = "".join(f"{EMULATED[name][0]:>24}" for name in COMPARED)
    yield f"  {'error over that of the mean of the other replicas':<56}{heading}"
    for label, row in found["schedules"].items():
        yield f"  {label:<56}" + "".join(f"{_times(row[name]['ratio']):>24}" for name in COMPARED)
    for packing, row in found["averages"].items():
        for words, key in (("mean", "ratio"), ("spread of the ensemble", "spread")):
            yield f"  {f'{words}, {packing} packing':<56}" + "".join(
                f"{_times(row[name][key]):>24}" for name in COMPARED
            )
        for rival in row[COMPARED[0]]["rivals"]:
            shown = "".join(f"{_times(row[name]['rivals'][rival]):>24}" for name in COMPARED)
            yield f"  {f'{rival}, {packing} packing':<56}{shown}"
    yield f"  {'a second of simulated time':<56}{1e3 * found['seconds_a_second']:>20.2f} ms"
    for row in found["dem"]:
        worst = None if None in row["floors"].values() else max(row["floors"].values())
        words = f"DEM, steps of {1e3 * row['time_step']:.3g} ms, worst figure in floors: {_times(worst)}"
        yield f"  {words:<56}{1e3 * row['seconds_a_second']:>20.0f} ms"


def _times(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.2f}"


def verdict(summary: Mapping[str, Any]) -> str:
    """Whether the requirements are met, and how many of the figures that none of them is about are unlike the DEM's."""
    figures = [row for judged in summary["judged"].values() for row in judged["figures"].values()]
    unlike, parts = sum(row["inside_interval"] is False for row in figures), requirements_met(summary)
    met, asked = (sum(counts) for counts in zip(*parts.values(), strict=True))
    words = f"all {asked} requirements met" if met == asked else f"{asked - met} of {asked} requirements NOT met"
    words += f" (met: {', '.join(f'{name} {one} of {of}' for name, (one, of) in parts.items())})"
    further = "lies" if unlike == 1 else "lie"
    return words + (f"; {counted(unlike, 'figure')} {further} outside the DEM's interval" if unlike else "")


def _row(name: str, found: str, last: str) -> str:
    return f"  {name:<64}{found:>18}  {last}"


def _figure(row: Mapping[str, Any], key: str = "value") -> str:
    if row[key] is None:
        return "undefined"
    factor, unit = (1e3, "mm") if row["unit"] == "m" else (1.0, row["unit"])
    return f"{factor * row[key]:.3g} {unit}".rstrip()


def _note(row: Mapping[str, Any]) -> str:
    return f"  [{row['note']}]" if row.get("note") else ""


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
    """Record what the judge said in an open run: metrics, tags, figures and a description that shows them."""
    # At step 0, because the UI draws a value of a later step as a curve of one point, and else as a bar a run.
    run.log_metrics(flat_metrics(summary), 0, supersede=True)
    kept = list(figures)
    for figure in kept:
        run.log_artifact(figure, FIGURES)
    for name, text in judged_tags(judged_words(summary), len(missed_requirements(summary))).items():
        run.set_tag(name, text)
    run.set_tag("model", summary["model"]["name"])
    if (parent := summary["training"].get("parent_run")) is not None:
        run.set_tag("parent_run", parent)
    run.set_tag("mlflow.note.content", description(summary, folder, [path.name for path in kept], run.run_id))


def description(summary: dict[str, Any], folder: Path, figures: Sequence[str], run_id: str | None) -> str:
    """A run's description in Markdown, with the named figures among the artifacts of a tracked run."""
    training, found = summary["training"], headline(summary)
    told = [line for line in (descent(training), cut_short(training)) if line is not None]
    lines = [
        f"**{summary['model']['name']}**, {training['parameters']} parameters, {training['steps']} updates; "
        f"{motion_words(summary['judged_rpm'])}, {summary['judged_as']}. **{verdict(summary)}.**",
        "",
        *(line for words in told for line in (f"**{words[0].upper()}{words[1:]}.**", "")),
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
    found, shared = headline(summary), summary["judged"]["shared"]
    heads = {key: f"{name} " for key, (name, _) in _HEADLINE_ERRORS.items() if key not in ranked_errors(shared)}
    named = [name for name in tracking.HEADLINE_FIGURES if not name.startswith(tuple(heads.values()))]
    return [name for name in (*named, *registered_metrics(shared)) if name not in found]
