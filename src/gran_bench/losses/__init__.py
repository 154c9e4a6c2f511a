"""What a window of frames ahead costs: terms by what they look at, and their weighted sum."""

from gran_bench.losses.frame_ahead import FrameAhead, LossError, Target, WindowLoss, frame_weights
from gran_bench.losses.terms import contact_overlaps  # the module registers the house's terms
