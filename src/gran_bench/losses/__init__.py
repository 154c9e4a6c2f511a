"""What a window of frames ahead costs: terms by what they look at, and their weighted sum."""

from gran_bench.losses.contacts import contact_overlaps
from gran_bench.losses.frame_ahead import FrameAhead, LossError, Target
from gran_bench.losses.window import TERMS, WindowLoss, frame_weights

__all__ = ["TERMS", "FrameAhead", "LossError", "Target", "WindowLoss", "contact_overlaps", "frame_weights"]
