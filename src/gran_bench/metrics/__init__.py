"""Judging: metrics with validity flags, the noise floor of the physics, and the judge."""

from gran_bench.metrics.judge import judge, nearest_case
from gran_bench.metrics.judgement import Judgement
from gran_bench.metrics.measured import Measured, Series
from gran_bench.metrics.position_error import divergence_horizon, short_horizon_errors, spread_starts
from gran_bench.metrics.summary import TrajectorySummary, summarise
