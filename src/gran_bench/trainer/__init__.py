"""Training: updates, checkpoints, resuming bit for bit."""

from gran_bench.trainer.trainer import (
    CHECKPOINT,
    DIVERGED,
    Trainer,
    TrainingDiverged,
    TrainingResult,
    TrainingStopped,
    frames_ahead,
    learning_rate,
)
