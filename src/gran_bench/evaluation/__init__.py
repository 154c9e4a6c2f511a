"""Judging a model: rollouts of every speed, replicas of the DEM, figures, a summary."""

from gran_bench.evaluation.evaluation import Evaluation, evaluate
