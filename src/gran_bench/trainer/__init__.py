"""Training: updates, checkpoints, resuming bit for bit."""
# ruff: noqa: F401

from gran_bench.trainer.schedule import frames_ahead, learning_rate
from gran_bench.trainer.trainer import CHECKPOINT, DIVERGED, Trainer, TrainingDiverged, TrainingResult, TrainingStopped
