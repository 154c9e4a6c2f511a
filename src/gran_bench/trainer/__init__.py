"""Training: updates, checkpoints, resuming bit for bit."""

from gran_bench.trainer.schedule import frames_ahead, learning_rate
from gran_bench.trainer.trainer import (
    CHECKPOINT,
    DIVERGED,
    Trainer,
    TrainingDiverged,
    TrainingResult,
    TrainingStopped,
)

__all__ = [
    "CHECKPOINT",
    "DIVERGED",
    "Trainer",
    "TrainingDiverged",
    "TrainingResult",
    "TrainingStopped",
    "frames_ahead",
    "learning_rate",
]
