"""What a method has to show to pass, as keys of the config."""

from __future__ import annotations  # the types of keys are read as words

from dataclasses import dataclass

from gran_bench.config.rules import Section, at_least, key, positive


@dataclass
class RequirementsConfig(Section, place="judge.requirements"):
    """What counts as met: noise floors of the scene, and bounds in its own units in their place where they are given.

    A scene whose DEM scatters more is asked for no more than the DEM keeps.
    """

    floors: float = key(4.0, positive("noise floors"))  # of each error, at most; of the 1 m drum's speeds 0.08 m/s
    speed_w1: float | None = key(None, positive("m/s"))  # of the speeds, W1 a frame; null: by floors
    steady_angle_deg: float | None = key(None, positive("°"))  # of both angles' steady means; null: series by floors
    peak_angle_deg: float | None = key(None, positive("°"))  # of both angles' first peaks; null: series by floors
    steady_from: float | None = key(None, at_least(0, "s"))  # start of the steady part; null: found from the DEM
    peak_before: float | None = key(None, at_least(0, "s"))  # end of the first peak; null: found from the DEM
