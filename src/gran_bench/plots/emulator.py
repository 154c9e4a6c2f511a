"""The emulator beside the DEM: its expectation with its spread, and every replica, over time."""

from collections.abc import Sequence
from pathlib import Path

from gran_bench.emulator.judging import JudgedRun
from gran_bench.emulator.runs import FIGURES
from gran_bench.plots.style import DEM, QUIET, SURROGATE, drawing
from gran_bench.scene.motion import RADIANS_PER_SECOND_PER_RPM

SHOWN = 4  # schedules in a figure
SERIES = ("surface_angle", "com_angle", "mean_speed")


def emulated_schedules(runs: Sequence[JudgedRun], path: Path | str) -> Path:
    """Draw the wall's speed and three figures of the first judged schedules: each replica, the expectation ± 2 s."""
    chosen = list(runs)[:SHOWN]
    with drawing(path, 3.6 * len(chosen), 9.0) as figure:
        scene = chosen[0].judged.replicas[0].scene
        figure.suptitle(f"{scene.name}: expectation of the emulator ± 2 standard deviations, replicas of the DEM")
        panels = figure.subplots(1 + len(SERIES), len(chosen), sharex="col", sharey="row", squeeze=False)
        for column, run in zip(panels.T, chosen, strict=True):
            said, rotation = run.said, run.judged.replicas[0].scene.rotation
            column[0].plot(said.time, rotation.angular_speed(said.time) / RADIANS_PER_SECOND_PER_RPM, color=QUIET)
            column[0].set_title(run.judged.label)
            for axes, name in zip(column[1:], SERIES, strict=True):
                place = said.columns[name].start
                for k, replica in enumerate(run.replicas):
                    label = "DEM" if k == 0 else None
                    axes.plot(said.time, replica[:, place], color=DEM, linewidth=0.6, alpha=0.6, label=label)
                mean, two = said.mean[:, place], 2.0 * said.spread[:, place]
                axes.fill_between(said.time, mean - two, mean + two, color=SURROGATE, alpha=0.25, linewidth=0)
                axes.plot(said.time, mean, color=SURROGATE, label="emulator")
            column[-1].set_xlabel("time, s")
        panels[0, 0].set_ylabel("drum, rpm")
        for axes, name in zip(panels[1:, 0], SERIES, strict=True):
            axes.set_ylabel(f"{FIGURES[name][0]}, {FIGURES[name][1]}")
        panels[1, 0].legend()
    return Path(path)
