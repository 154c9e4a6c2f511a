"""The balance of a run that counted its energy: what the walls give is stored, leaves with spheres, or is lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gran_bench.state import FloatArray, Trajectory

KINETIC = ("kinetic_energy_translational", "kinetic_energy_rotational")
STORED = ("potential_energy", "elastic_normal", "elastic_tangential", "elastic_rolling")


@dataclass(frozen=True)
class EnergyBalance:
    """Means over the frames of a run, each from the state before, W.

    P = dE/dt + outflow + Σ losses + unaccounted,    E = kinetic + potential + elastic energy
    """

    time: FloatArray  # ``(F − 1,)`` s, end of each frame
    power: FloatArray  # ``(F − 1,)`` P that the walls give the spheres
    storing: FloatArray  # ``(F − 1,)`` dE/dt
    outflow: FloatArray  # ``(F − 1,)`` energy of the spheres that leave through the outlet
    losses: dict[str, FloatArray]  # ``(F − 1,)`` each, by ``loss_sliding``, ``wall_loss_sliding`` …

    @classmethod
    def of(cls, trajectory: Trajectory) -> EnergyBalance:
        """The balance of a trajectory.

        Raises:
            ValueError: a run that did not count its energy.
        """
        energy = trajectory.energy
        if not energy:
            raise ValueError("the run did not count its energy; make it with dem.power=true")
        total = sum(trajectory.diagnostics[name] for name in KINETIC) + sum(energy[name] for name in STORED)
        interval = np.diff(trajectory.time)
        outflow = np.diff(energy.get("discharged_energy", np.zeros_like(total)))
        names = [name for name in energy if name.startswith(("loss_", "wall_loss_"))]
        return cls(
            trajectory.time[1:], energy["wall_power"][1:].sum(axis=1), np.diff(total) / interval, outflow / interval,
            {name: energy[name][1:] for name in names},
        )  # fmt: skip

    @property
    def loss(self) -> FloatArray:
        """Sum of all losses, ``(F − 1,)`` W."""
        return np.sum(list(self.losses.values()), axis=0)

    @property
    def unaccounted(self) -> FloatArray:
        """What the terms leave open, ``(F − 1,)`` W."""
        return self.power - self.storing - self.outflow - self.loss

    def figures(self, start: float, end: float = np.inf) -> dict[str, float]:
        """Means over the frames that end in start < t ≤ end, s, in W by name; empty where there is none."""
        half = 0.5 * float(np.diff(self.time).min()) if len(self.time) > 1 else 0.0
        chosen = (self.time > start + half) & (self.time <= end + half)
        if not chosen.any():
            return {}
        found = {"power_W": self.power, "storing_W": self.storing, "outflow_W": self.outflow, "loss_W": self.loss}
        found |= {f"{name}_W": values for name, values in self.losses.items()}
        found["unaccounted_W"] = self.unaccounted
        return {name: float(values[chosen].mean()) for name, values in found.items()}
