"""What of the physics a scene needs; everything else is skipped."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Needs:
    """What of the physics a scene needs; everything else is skipped."""

    tangential: bool  # a tangential law, spin and history: only with friction
    rolling: bool  # a rolling model: only with rolling friction
    walls: bool
    wall_motion: bool  # wall velocities: only where a wall's surface moves
    wall_geometry: bool  # walls that are elsewhere, or gone, in the next step
    wall_seams: bool  # walls that are pieces of one surface, which answers a sphere once
    end_caps: bool
    periodic: bool
    gravity: bool
    materials: bool  # several particle materials, a law for each pair of them
    polydispersity: bool  # several radii
    outlet: bool  # spheres that leave

    def __str__(self) -> str:
        needed = [name for name in self.__dataclass_fields__ if getattr(self, name)]
        skipped = [name for name in self.__dataclass_fields__ if not getattr(self, name)]
        return f"needs {', '.join(needed) or 'nothing'}; skips {', '.join(skipped) or 'nothing'}"
