"""The lattice basis: a kernel stored on a regular lattice of the cube, read by trilinear interpolation."""

import math

import torch
from torch import Tensor

from gran_bench.config import CconvModelConfig
from gran_bench.config.rules import checked

_CENTRE = 1.0e-6  # of the radius: closer to the middle than this, directions are noise and the point is the centre


def ball_to_cube(vector: Tensor) -> Tensor:
    """Map the unit ball onto the cube [−1, 1]³ so that equal volumes stay equal (up to one constant).

    First ball → cylinder: near the poles (5/4 z² > x² + y²), (x, y) √(3r/(r + |z|)) and ±r; else (x, y) r/ρ and
    3/2 z, with ρ = √(x² + y²). Then disc → square in every cross-section: the larger of x and y becomes ±ρ, the
    other ±ρ (4/π) atan(smaller/larger). The map is odd: Λ(−x) = −Λ(x). Points are ``(M, 3)``.

    Source: Griepentrog, Höppner, Kaiser & Rehberg (2008), A bi-Lipschitz continuous, volume preserving map from the
    unit ball onto a cube, Note di Matematica 28.
    """
    x, y, z = vector.unbind(-1)
    planar = x * x + y * y
    squared = planar + z * z
    centre = squared < _CENTRE**2
    # Divisions and roots of the branch that is not taken are kept finite, so that its gradient is 0 and not nan.
    radius = torch.sqrt(torch.where(centre, torch.ones_like(squared), squared))
    polar = 1.25 * z * z > planar
    flat = torch.where(polar | centre, torch.ones_like(planar), planar)
    stretch = torch.where(polar, torch.sqrt(3.0 * radius / (radius + z.abs())), radius / torch.sqrt(flat))
    height = torch.where(polar, torch.copysign(radius, z), 1.5 * z)
    x, y = x * stretch, y * stretch

    planar = x * x + y * y
    axis = planar < _CENTRE**2
    rho = torch.sqrt(torch.where(axis, torch.ones_like(planar), planar))
    along_x = y.abs() <= x.abs()
    larger = torch.where(along_x, x, y)
    ratio = torch.where(along_x, y, x) / torch.where(axis, torch.ones_like(larger), larger)
    major = torch.copysign(rho, larger)
    minor = major * (4.0 / math.pi) * torch.atan(ratio)
    cube_x = torch.where(along_x, major, minor)
    cube_y = torch.where(along_x, minor, major)
    on_axis = torch.zeros_like(x)
    cube_x, cube_y = torch.where(axis, on_axis, cube_x), torch.where(axis, on_axis, cube_y)
    cube = torch.stack((cube_x, cube_y, height), dim=-1)
    return torch.where(centre[:, None], torch.zeros_like(cube), cube)


class LatticeBasis:
    """k³ hat functions on a lattice whose outermost nodes lie on the faces of the cube.

    A point uses eight of them: the corners of its cell. Function (z k + y) k + x belongs to node (x, y, z).

    Args:
        radius: R of the ball that the cube stands for, m.
        edge: k, nodes along an edge; at least 2.

    Attributes:
        size: k³.
        offsets: the eight functions that a point uses, relative to the first.
        mirror: ``(size,)`` the function that −x uses where x uses this one.
        mirror_sign: ``(size,)`` its sign; +1 throughout.
    """

    def __init__(self, radius: float, edge: int = 4) -> None:
        checked(CconvModelConfig, "kernel_size", edge)
        self.radius = radius
        self.edge = edge
        self.size = edge**3
        self.offsets = tuple((z * edge + y) * edge + x for z in (0, 1) for y in (0, 1) for x in (0, 1))
        self.mirror = torch.arange(self.size - 1, -1, -1)
        self.mirror_sign = torch.ones(self.size)

    def evaluate(self, relative: Tensor) -> tuple[Tensor, Tensor]:
        """The eight functions that vectors ``(M, 3)`` m of at most R use: the first ``(M,)``, and values ``(M, 8)``."""
        coordinate = (ball_to_cube(relative / self.radius) + 1.0) * (0.5 * (self.edge - 1))
        cell = coordinate.detach().floor().clamp_(0, self.edge - 2)
        upper = coordinate - cell
        x, y, z = torch.stack((1.0 - upper, upper), dim=1).unbind(-1)
        value = (z[:, :, None, None] * y[:, None, :, None] * x[:, None, None, :]).flatten(1)
        i, j, k = cell.long().unbind(-1)
        return (k * self.edge + j) * self.edge + i, value

    def turned(self, first: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """First function and values for the vectors turned round: the mirrored cell, its corners in reverse order."""
        return self.size - 1 - self.offsets[-1] - first, value.flip(-1)
