"""When a bed is at rest: when it stays slow for as long as its slowest swing can hide.

That is half the period of a sphere that rolls in a trough as wide as the height H that a sphere can fall,

    T/2 = π √(7/5 · H/2 / g)

Slow means that the root mean square of the speeds lies below v = ``scene.settled_speed``, and that none is faster
than 30 v. Spin does not count: nothing brakes a sphere that spins about its contact's normal.
"""

import math

import numpy as np

from gran_bench.dem.outlet import taking_part
from gran_bench.dem.time_step import NOMINAL_FALL
from gran_bench.dem.vectors import dot
from gran_bench.scene import Scene
from gran_bench.state import FloatArray

# Of a single sphere's speed to the bed's. At 0.03 m/s a sphere rises by 46 µm; what rolls that slowly in its cage on a
# floor, without rolling friction, takes tens of seconds to stop.
LONE_SPHERE = 30.0
WEIGHTLESS = 10.0  # frames; where nothing falls, nothing swings
LOOKS = 20  # at least, in that time


class Rest:
    """Looks at a bed that settles in a scene, and keeps since when it has been slow."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._slow_since = scene, math.inf
        self.speed, self._fastest, self._fastest_speed = math.inf, 0, math.inf
        fall, gravity = scene.fall_height or NOMINAL_FALL * scene.filling.diameter, scene.gravity_strength
        self.window = (
            math.pi * math.sqrt(0.7 * fall / gravity) if gravity else WEIGHTLESS * scene.frame_interval
        )  # of slowness, s
        self.look_interval = self.window / LOOKS  # longest time between two looks, s

    def look(self, time: float, position: FloatArray, velocity: FloatArray) -> bool:
        """Whether the bed, which is so at a time, s, has been slow for long enough, as often as it was looked at."""
        inside = taking_part(self._scene, position)
        speed = np.where(inside, np.sqrt(dot(velocity, velocity)), 0.0)
        self.speed = math.sqrt(float(np.square(speed).sum()) / max(1, np.count_nonzero(inside)))
        self._fastest, self._fastest_speed = int(speed.argmax()), float(speed.max())
        limit = self._scene.settled_speed
        if self.speed >= limit or self._fastest_speed >= LONE_SPHERE * limit:
            self._slow_since = math.inf
        else:
            self._slow_since = min(self._slow_since, time)
        return time - self._slow_since >= self.window * (1.0 - 1e-9)

    def what_moves(self) -> str:
        """The last look in words, and what would help."""
        remedy = "raise scene.filling.longest_settling_fall_times or scene.filling.settled_froude"
        if not self._scene.needs.tangential:
            remedy = f"nothing brakes a swing where scene.material.friction=0: choose a friction > 0, or {remedy}"
        elif not self._scene.needs.rolling:
            remedy = f"nothing brakes a roll where scene.material.rolling_friction=0: choose e.g. 0.05, or {remedy}"
        return (
            f"particle {self._fastest} moves at {self._fastest_speed:.2g} m/s, the root mean square is "
            f"{self.speed:.2g} m/s, and at rest it stays below "
            f"{self._scene.settled_speed:.4g} m/s (scene.filling.settled_froude) for {self.window:.2g} s; {remedy}"
        )
