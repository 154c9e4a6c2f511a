"""Training: updates, checkpoints, resuming bit for bit."""

from gran_bench.trainer.trainer import (
    Trainer,
    TrainingDiverged,
    TrainingResult,
    TrainingStopped,
    frames_ahead,
    learning_rate,
)

__all__ = ["Trainer", "TrainingDiverged", "TrainingResult", "TrainingStopped", "frames_ahead", "learning_rate"]
