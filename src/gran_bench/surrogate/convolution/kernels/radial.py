"""The radial basis: hat functions of the distance times {1, x̂, ŷ, ẑ}."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

# Dense where spheres touch, in particle diameters; the support radius closes the list.
NODES = (0.8, 0.95, 1.02, 1.12, 1.4, 1.8)
_HARMONICS = 4


class RadialBasis:
    """Piecewise linear in the distance, of order 0 and 1 in the direction.

    A lattice of k³ nodes cannot tell a gap from an overlap at r = d; hat functions with nodes around d can. Below the
    first node the first hat stays at 1. Function 4n + 0 is hat n, 4n + 1…3 are hat n times x̂, ŷ, ẑ.

    Args:
        nodes: increasing distances, m; the last is the support radius R. At least 2.

    Attributes:
        size: 4 × number of nodes.
        offsets: the eight functions that a vector uses (two hats), relative to the first.
        mirror: ``(size,)`` the function that −x uses where x uses this one: itself.
        mirror_sign: ``(size,)`` its sign: −1 for the directions.

    Raises:
        ValueError: nodes that do not increase.
    """

    def __init__(self, nodes: tuple[float, ...]) -> None:
        if len(nodes) < 2 or nodes[0] < 0 or any(b <= a for a, b in itertools.pairwise(nodes)):
            raise ValueError(f"radial nodes {list(nodes)} m must be two or more, not negative, and increase")
        self.nodes = tuple(nodes)
        self.radius = self.nodes[-1]
        self.size = _HARMONICS * len(nodes)
        self.offsets = tuple(range(2 * _HARMONICS))
        self.mirror = torch.arange(self.size)
        self.mirror_sign = torch.tensor((1.0, -1.0, -1.0, -1.0)).repeat(len(nodes))

    @classmethod
    def around_contact(cls, diameter: float, radius: float, contact: float | None = None) -> RadialBasis:
        """Nodes around the distance at which two bodies touch: d by default, d/2 for points of a wall's surface."""
        shift = diameter - (diameter if contact is None else contact)
        inner = [n * diameter - shift for n in NODES]
        # Nodes that crowd the support radius would make hats that no particle ever sees.
        return cls((*(n for n in inner if n < 0.95 * radius), radius))

    def evaluate(self, relative: Tensor) -> tuple[Tensor, Tensor]:
        """The eight functions that vectors ``(M, 3)`` m of at most R use: the first ``(M,)``, and values ``(M, 8)``."""
        x, y, z = relative.unbind(-1)
        squared = x * x + y * y + z * z
        apart = squared > 0
        distance = torch.sqrt(torch.where(apart, squared, torch.ones_like(squared))) * apart
        direction = relative / torch.where(apart, distance, torch.ones_like(distance))[:, None]
        # A comparison with each of the few inner nodes is faster than a search among them.
        below = torch.zeros_like(distance, dtype=torch.int64)
        for node in self.nodes[1:-1]:
            below += distance.detach() >= node
        nodes = relative.new_tensor(self.nodes)
        start, width = nodes.index_select(0, below), nodes.diff().index_select(0, below)
        upper = ((distance - start) / width).clamp(0.0, 1.0)
        hats = torch.stack((1.0 - upper, upper), dim=1)
        harmonics = torch.cat((torch.ones_like(distance)[:, None], direction), dim=1)
        value = (hats[:, :, None] * harmonics[:, None, :]).flatten(1)
        return _HARMONICS * below, value

    def turned(self, first: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """First function and values for the vectors turned round: directions change their sign."""
        return first, value * self.mirror_sign[:8].to(value)
