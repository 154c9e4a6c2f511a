"""Training: updates, checkpoints, resuming bit for bit."""

from gran_bench.trainer.schedule import frames_ahead, learning_rate, work_of_updates
from gran_bench.trainer.trainer import (
    CHECKPOINT,
    DIVERGED,
    Trainer,
    TrainingDiverged,
    TrainingResult,
    TrainingStopped,
)
