"""The figures of an evaluated model: candidates, by their names, over the range of the DEM's replicas."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.patches import Rectangle

from gran_bench.evaluation import Evaluation
from gran_bench.evaluation.plan import packing_words, rollout_name
from gran_bench.metrics.measured import Measured, Series, frame_at
from gran_bench.metrics.position_error import DIVERGED, divergence_horizon, mean_spread, separation
from gran_bench.metrics.summary import TrajectorySummary
from gran_bench.plots.flow import default_title, flow_animation, flow_pattern
from gran_bench.plots.power import energy_balance
from gran_bench.plots.style import BAND, DEM, SURROGATE, coloured, drawing, mark_place, say, speed_label, titled
from gran_bench.state import FloatArray

Candidates = Mapping[str, TrajectorySummary]
Replicas = Sequence[TrajectorySummary]

ANGLES = (("surface_angle", "Surface angle of repose"), ("com_angle", "Angle of the centre of mass"))
# Name of the series, title, label of the axis, and the axis' unit over the series' one.
DIAGNOSTICS = (
    ("translational_energy", "Translational energy", "energy, J", 1.0),
    ("rotational_energy", "Rotational energy", "energy, J", 1.0),
    ("mixing", "Mixing of the two halves", "entropy, 1 is mixed", 1.0),
    ("overlap_mean", "Mean overlap of touching pairs", "overlap, mm", 1e3),
    ("overlap_max", "Largest overlap of a pair", "overlap, mm", 1e3),
    ("wall_overlap_max", "Largest overlap with a wall", "overlap, mm", 1e3),
)
PURPOSE = (
    ("center_height", "Height of the centre of mass", "height, m", 1.0),
    ("discharge_rate", "Discharge rate", "rate, kg/s", 1.0),
    ("packing_fraction", "Packing fraction of the bed's lower half", "fraction", 1.0),
    ("mean_speed", "Mean speed", "speed, m/s", 1.0),
)
USUAL = (1e-4, 30.0)  # d; the axis of every run that stays within, so that figures can be compared
CLASS = 0.1  # m/s
WIDEST = 10.0  # times the speeds of the DEM: a wild model would leave no room for it


def draw_evaluation(
    evaluation: Evaluation, holdout_rpm: float | None, folder: Path | str, gif: bool = True,
    model_name: str = "surrogate",
) -> list[Path]:  # fmt: skip
    """Draw the paper's figures of the held-out speed for both packings, those of the unseen one ending in ``_unseen``.

    With ``gif`` there is a film of both flows, too. Returns the paths, those of the paper's figures first.
    """
    folder, paths = Path(folder), []
    for packing, replicas in evaluation.replicas.items():
        unseen = packing == "unseen"
        name, suffix = rollout_name(holdout_rpm, unseen), "_unseen" if unseen else ""
        case, candidate = evaluation.cases[name], {model_name: evaluation.candidates[packing]}
        runs = {"DEM": case.trajectory, model_name: evaluation.rollouts[name].trajectory}
        with titled(f"{default_title(case.scene)}, {packing_words(packing, holdout_rpm)}"):
            instant = replicas[0].phases.pattern_time
            paths.append(flow_pattern(runs, case.scene, folder / f"flow_pattern{suffix}.png", instant))
            first, last = (purpose,), (diagnostics,)
            if case.scene.drum_radius is not None:
                first, last = (angle_of_repose,), (speed_by_depth, diagnostics)
            for draw in (*first, speed_distribution, position_error, *last):
                paths.append(draw(candidate, replicas, folder / f"{draw.__name__}{suffix}.png"))
            if case.trajectory.energy:
                path = folder / f"energy_balance{suffix}.png"
                paths.append(energy_balance(case.trajectory, path, replicas[0].phases.steady_from))
            if gif and not unseen:
                paths.append(flow_animation(runs, case.scene, folder / "flow.gif"))
    if not (rows := evaluation.summary["nearest_case"].values()):
        return paths
    speeds = {rollout_name(row["own_rpm"]): row["own_rpm"] for row in rows}
    distances = {row["own_rpm"]: {speeds[name]: value for name, value in row["w1_m_s"].items()} for row in rows}
    with titled(f"{evaluation.cases[rollout_name(holdout_rpm)].scene.name}, shared packing"):
        return [*paths, nearest_cases(distances, folder / "nearest_case.png")]


def angle_of_repose(candidates: Candidates, replicas: Replicas, path: Path | str) -> Path:
    """Draw the angle of repose against time by both definitions (paper, Fig. 3a).

    A state without a valid angle leaves a gap; a scene without an angle of repose says so.
    """
    with drawing(path, 8.0, 5.6) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for axes, (name, title) in zip(panels, ANGLES, strict=True):
            axes.set(title=title, ylabel="angle, °")
            _draw_series(axes, name, candidates, replicas)
            if not replicas[0].series[name].undefined_because and replicas[0].phases.steady_from is not None:
                mark_place(axes, replicas[0].phases.steady_from, "steady")
        if panels[0].get_legend_handles_labels()[0]:
            panels[0].legend(loc="upper right", ncols=1)
        panels[-1].set(xlabel="time, s", xlim=(replicas[0].time[0], replicas[0].time[-1]))
    return Path(path)


def purpose(candidates: Candidates, replicas: Replicas, path: Path | str) -> Path:
    """Draw what a scene without an angle is for, against time: height, discharge rate, packing fraction, speed."""
    rows = [entry for entry in PURPOSE if not replicas[0].series[entry[0]].undefined_because]
    with drawing(path, 8.0, 2.6 * len(rows)) as figure:
        panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (name, title, label, scale) in zip(panels, rows, strict=True):
            axes.set(title=title, ylabel=label)
            _draw_series(axes, name, candidates, replicas, scale)
        panels[0].legend(loc="best")
        panels[-1].set(xlabel="time, s", xlim=(replicas[0].time[0], replicas[0].time[-1]))
    return Path(path)


def diagnostics(candidates: Candidates, replicas: Replicas, path: Path | str) -> Path:
    """Draw energy, overlap and mixing against time: what a flow that looks right may still get wrong."""
    with drawing(path, 11.0, 5.8) as figure:
        panels = figure.subplots(2, 3, sharex=True)
        for axes, (name, title, label, scale) in zip(panels.ravel(), DIAGNOSTICS, strict=True):
            axes.set(title=title, ylabel=label)
            if _draw_series(axes, name, candidates, replicas, scale):
                axes.set_ylim(bottom=0.0)
        for axes in panels[-1]:
            axes.set_xlabel("time, s")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower left", ncols=4)
    return Path(path)


def _draw_series(axes: Axes, name: str, candidates: Candidates, replicas: Replicas, scale: float = 1.0) -> bool:
    """A series of all runs, or why the DEM has none; whether it has one."""
    if refusal := next((run.series[name].undefined_because for run in replicas), ""):
        say(axes, f"undefined:\n{refusal}")
        return False
    values = scale * np.array([shown(run.series[name]) for run in replicas])
    known, time, count = np.isfinite(values).any(axis=0), replicas[0].time, len(replicas)
    low, middle, high = np.full((3, values.shape[1]), np.nan)
    low[known], high[known] = np.nanmin(values[:, known], axis=0), np.nanmax(values[:, known], axis=0)
    middle[known] = np.nanmean(values[:, known], axis=0)
    if count > 1:
        axes.fill_between(time, low, high, color=BAND, linewidth=0, label=f"DEM, range of {count} replicas")
    axes.plot(time, middle, color=DEM, linewidth=1.3, label="DEM, mean" if count > 1 else "DEM")
    for (label, run), colour in coloured(candidates.items()):
        draw_run(axes, run.series[name], run.series[name].undefined_because or label, colour, scale)
    return True


def draw_run(axes: Axes, series: Series, label: str, colour: str, scale: float = 1.0) -> None:
    """Draw one run; its label counts the states that have no valid value."""
    bad = int((~series.valid).sum())
    note = f" ({bad} of {len(series.value)} states invalid)" if bad else ""
    axes.plot(series.time, scale * shown(series), color=colour, label=label + note)


def shown(series: Series) -> FloatArray:
    """The values of a series, NaN where a state has no valid one."""
    return np.where(series.valid, series.value, np.nan)


def speed_by_depth(candidates: Candidates, replicas: Replicas, path: Path | str) -> Path:
    """Draw the steady flow's mean velocity along the surface in layers of one diameter under it."""
    truth = np.array([speed for run in replicas if np.isfinite(speed := run.layer_velocity).any()])
    with drawing(path, 5.2, 4.8) as figure:
        axes = figure.subplots()
        axes.set(xlabel="velocity along the surface, uphill, m/s", ylabel="depth under the surface, d")
        axes.set_title("Steady flow under the surface")
        refusal = replicas[0].phases.not_steady_because
        if refusal or not len(truth):
            say(axes, f"undefined:\n{refusal or 'no valid surface'}")
            return Path(path)
        # Layers that hold spheres in every replica; deeper ones are the drum's wall.
        layers = np.flatnonzero(np.isfinite(truth).all(axis=0))
        depth, values = layers + 0.5, truth[:, layers]
        if len(truth) > 1:
            label = f"DEM, range of {len(truth)} replicas"
            axes.fill_betweenx(depth, values.min(axis=0), values.max(axis=0), color=BAND, linewidth=0, label=label)
        axes.plot(values.mean(axis=0), depth, color=DEM, linewidth=1.3, marker="o", markersize=3, label="DEM, mean")
        for (name, run), colour in coloured(candidates.items()):
            found = np.full(len(layers), np.nan)
            mine = run.layer_velocity
            known = layers < len(mine)
            found[known] = mine[layers[known]]
            note = "" if np.isfinite(found).any() else ": no valid surface"
            axes.plot(found, depth, color=colour, marker="o", markersize=3.5, label=name + note)
        axes.axvline(0.0, color="#999999", linewidth=0.8)
        axes.set_ylim(layers[-1] + 1.0, 0.0)
        axes.legend(loc="lower left")
    return Path(path)


def speed_distribution(candidates: Candidates, replicas: Replicas, path: Path | str) -> Path:
    """Draw the share of spheres in classes of 0.1 m/s of speed at the pattern's instant (paper, Fig. 3b)."""
    time = replicas[0].phases.pattern_time
    truth = [speed for run in replicas if (speed := _speeds(run, time)) is not None]
    found = {name: _speeds(run, time) for name, run in candidates.items()}
    known = [speed for speed in found.values() if speed is not None]
    own, top = (max((float(np.quantile(speed, 0.999)) for speed in runs), default=1.0) for runs in (truth, known))
    top = max(own, min(top, WIDEST * max(own, CLASS)))  # what is faster is told in the legend
    edges = CLASS * np.arange(int(np.ceil(top / CLASS)) + 2)
    with drawing(path, 7.0, 4.0) as figure:
        axes = figure.subplots()
        if truth:
            shares = 100.0 * np.array([np.histogram(speed, edges)[0] / len(speed) for speed in truth])
            if len(truth) > 1:
                label = f"DEM, range of {len(truth)} replicas"
                axes.stairs(shares.max(0), edges, baseline=shares.min(0), fill=True, color=BAND, label=label)
            axes.stairs(shares.mean(axis=0), edges, color=DEM, linewidth=1.4, label="DEM, mean")
        for (name, speed), colour in coloured(found.items()):
            if speed is None:
                axes.plot([], [], color=colour, label=f"{name}: not finite at {time:g} s")
                continue
            beyond = 100.0 * float((speed > edges[-1]).mean())
            note = f" ({beyond:.2g} % faster than shown)" if beyond > 0 else ""
            share = 100.0 * np.histogram(speed, edges)[0] / len(speed)
            axes.stairs(share, edges, color=colour, linewidth=1.8, label=name + note)
        axes.set(title=f"Speeds at {time:g} s", ylabel=f"share of spheres in {CLASS:g} m/s, %", ylim=(0.0, None))
        axes.set(xlabel=speed_label(replicas[0].velocity_kind), xlim=(0.0, edges[-1]))
        axes.legend(loc="upper right")
    return Path(path)


def _speeds(run: TrajectorySummary, time: float) -> FloatArray | None:
    frame = frame_at(run.time, time)
    return None if frame is None or not np.isfinite(run.sorted_speed[frame]).all() else run.sorted_speed[frame]


def position_error(candidates: Candidates, replicas: Replicas, path: Path | str) -> Path:
    """Draw the mean distance to the DEM's spheres, in d and mm, and the horizon beyond which the DEM's runs differ."""
    diameter, period, frames = replicas[0].diameter, replicas[0].period, len(replicas[0].time)
    with drawing(path, 7.6, 4.3) as figure:
        axes, drawn = figure.subplots(), []
        for (name, run), colour in coloured(candidates.items()):
            if run.position is None:
                continue
            if run.position.shape[1] != replicas[0].position.shape[1]:
                axes.plot([], [], color=colour, label=f"{name}: other spheres than the DEM's")
                continue
            shared = min(len(run.time), frames)
            apart = [separation(run.position[:shared], truth.position[:shared], period) for truth in replicas]
            error = np.mean(apart, axis=0)
            lost = int((~np.isfinite(error)).sum()) + frames - shared
            note = f" ({lost} frames not finite or missing)" if lost else ""
            axes.plot(np.arange(1, shared), error[1:] / diameter, color=colour, label=f"{name} to DEM{note}")
            drawn.append(error[1:] / diameter)
        if len(replicas) > 1:
            spread = mean_spread([run.position for run in replicas], period)
            label = "DEM replica to replica (2e-8 d apart)"
            axes.plot(np.arange(1, frames), spread[1:] / diameter, color=DEM, label=label)
            drawn.append(spread[1:] / diameter)
            horizon = divergence_horizon(spread, diameter)
            if horizon is not None:
                axes.axvspan(horizon, frames, color="#f2f2f2", zorder=0)
                late = horizon > frames**0.7  # on a logarithmic axis; there is no room to its right
                words = f"frame {horizon}:\nreplicas {DIVERGED:g} d apart,\nbeyond it only\nstatistics compare"
                mark_place(axes, horizon, words, ha="right" if late else "left")
        axes.set(xscale="log", yscale="log", xlim=(1, frames - 1), ylim=_range(drawn))
        axes.set_xticks([tick for tick in (1, 3, 10, 30, 100, 300, 1000) if tick < frames], minor=False)
        interval = 1e3 * float(replicas[0].time[1] - replicas[0].time[0])
        axes.set(xlabel=f"frames after the settled state ({interval:g} ms each)", ylabel="mean position error, d")
        right = axes.secondary_yaxis("right", functions=(lambda x: x * 1e3 * diameter, lambda x: x / (1e3 * diameter)))
        right.set_ylabel("mm")
        for axis in (axes.xaxis, axes.yaxis, right.yaxis):
            axis.set_major_formatter("{x:g}")
        axes.set_title("Position error of the rollout")
        axes.legend(loc="upper left")
    return Path(path)


def _range(errors: Sequence[FloatArray]) -> tuple[float, float]:
    """Ends of the axis, d: the usual ones, or as far beyond as a run goes."""
    known = np.concatenate([np.asarray(error, np.float64) for error in errors] or [np.zeros(0)])
    known = known[np.isfinite(known) & (known > 0)]
    low, high = known.min(initial=USUAL[0]), known.max(initial=USUAL[1])
    return (low if low == USUAL[0] else 0.5 * low), (high if high == USUAL[1] else 2.0 * high)


def nearest_cases(distances: Mapping[float, Mapping[float, Measured | float | None]], path: Path | str) -> Path:
    """Draw how far each rollout is from every case of the DEM, by their speeds (rpm); the nearest of a row is framed.

    Distances are speed W1 a frame, m/s; None or undefined for a rollout that failed.
    """
    rows, columns = sorted(distances), sorted({rpm for row in distances.values() for rpm in row})
    found = [[distances[row].get(column) for column in columns] for row in rows]
    table = np.array([[one.value if isinstance(one, Measured) else one for one in row] for row in found], float)
    with drawing(path, max(4.8, 1.6 + 0.85 * len(columns)), 1.7 + 0.6 * len(rows)) as figure:
        axes = figure.subplots()
        top = float(np.nanmax(table)) if np.isfinite(table).any() else 1.0
        axes.imshow(table, cmap="Blues", norm=Normalize(0.0, top), aspect="auto")
        for (i, j), value in np.ndenumerate(table):
            words, shade = (
                f"{value:.3f}" if np.isfinite(value) else "failed",
                "white" if value > 0.55 * top else "black",
            )
            axes.text(j, i, words, ha="center", va="center", color=shade)
        for i, row in enumerate(rows):
            if np.isfinite(table[i]).all():
                nearest = int(np.argmin(table[i]))
                edge, line = ("black", "-") if columns[nearest] == row else (SURROGATE, "--")
                corner = (nearest - 0.47, i - 0.45)
                axes.add_patch(Rectangle(corner, 0.94, 0.9, fill=False, linewidth=2.2, edgecolor=edge, linestyle=line))
        axes.set_xticks(range(len(columns)), [f"{rpm:g}" for rpm in columns])
        axes.set_yticks(range(len(rows)), [f"{rpm:g}" for rpm in rows])
        axes.set(xlabel="case of the DEM, rpm", ylabel="rollout, rpm", title="Speed W1 a frame, m/s (framed: nearest)")
        axes.grid(False)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
    return Path(path)
