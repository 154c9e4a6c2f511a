"""Rollouts judged against the DEM."""

from gran_bench.evaluation.evaluation import Evaluation, evaluate, predict_from, weights_digest

__all__ = ["Evaluation", "evaluate", "predict_from", "weights_digest"]
