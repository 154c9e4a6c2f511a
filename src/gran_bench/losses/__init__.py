"""What a window of frames ahead costs: terms by what they look at, and their weighted sum."""
# ruff: noqa: F401

# Each module registers its terms.
from gran_bench.losses import bulk, contacts, particles
from gran_bench.losses.contacts import contact_overlaps
from gran_bench.losses.frame_ahead import FrameAhead, LossError, Target, WindowLoss, frame_weights
