"""Figures: legible, with units, colour-blind safe, written whole or not at all."""

from gran_bench.plots.angle import angle_of_repose
from gran_bench.plots.animation import flow_animation
from gran_bench.plots.case_card import case_card
from gran_bench.plots.depth import speed_by_depth
from gran_bench.plots.diagnostics import diagnostics
from gran_bench.plots.drum_flow import draw_drum_flow
from gran_bench.plots.evaluation import draw_evaluation
from gran_bench.plots.flow_pattern import flow_pattern
from gran_bench.plots.hopper_discharge import draw_discharge
from gran_bench.plots.losses import loss_curves
from gran_bench.plots.nearest import nearest_cases
from gran_bench.plots.position_error import position_error
from gran_bench.plots.scene_state import scene_state
from gran_bench.plots.speeds import speed_distribution
from gran_bench.plots.style import drawn_for
from gran_bench.plots.sweep import sweep_axis
from gran_bench.plots.time_error import Contender, time_against_error

__all__ = [
    "Contender",
    "angle_of_repose",
    "case_card",
    "diagnostics",
    "draw_discharge",
    "draw_drum_flow",
    "draw_evaluation",
    "drawn_for",
    "flow_animation",
    "flow_pattern",
    "loss_curves",
    "nearest_cases",
    "position_error",
    "scene_state",
    "speed_by_depth",
    "speed_distribution",
    "sweep_axis",
    "time_against_error",
]
