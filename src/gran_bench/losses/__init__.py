"""What a window of frames ahead costs: terms by what they look at, and their weighted sum."""

# Each module registers its terms.
from gran_bench.losses import bulk as bulk
from gran_bench.losses import contacts as contacts
from gran_bench.losses import particles as particles
from gran_bench.losses.contacts import contact_overlaps
from gran_bench.losses.frame_ahead import FrameAhead, LossError, Target, WindowLoss, frame_weights

__all__ = ["FrameAhead", "LossError", "Target", "WindowLoss", "contact_overlaps", "frame_weights"]
