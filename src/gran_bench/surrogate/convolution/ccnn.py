"""The continuous-convolution network: contact accelerations from a particle and a wall branch."""

import itertools
import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from gran_bench.config import BoundaryConfig, CconvModelConfig, Lu2021Config, XuShen2022Config
from gran_bench.config.choices import check_radius, given_or
from gran_bench.config.consistency import check_model
from gran_bench.config.rules import ConfigError
from gran_bench.scene import Scene
from gran_bench.surrogate.convolution.antisymmetric import AntisymmetricLayer
from gran_bench.surrogate.convolution.boundary import KINDS, WallPairs, see_contacts, see_spheres
from gran_bench.surrogate.convolution.cconv import ContinuousConvolution
from gran_bench.surrogate.convolution.kernels.lattice import LatticeBasis
from gran_bench.surrogate.convolution.kernels.radial import RadialBasis
from gran_bench.surrogate.convolution.neighborhood import (
    KernelBasis,
    Neighborhood,
    nearness,
    particle_neighborhood,
    weigh_pairs,
)
from gran_bench.surrogate.step import NewtonSurrogate

_SOLID_FRACTION = 0.58  # of a settled bed; only sets the scale of the first weights
_FRAMES = 5.0  # velocities count diameters in so many frames: m/s where d = 50 mm and Δt = 10 ms
_OUTPUT_START = 0.1  # first output weights, of their usual size: an untrained network starts near pure gravity


class MixingLayer(nn.Module):
    """convolution(h) + W h + b of h = ReLU(features); with ``residual``, + features where C_in = C_out."""

    def __init__(
        self,
        width_in: int,
        width_out: int,
        basis: KernelBasis,
        config: CconvModelConfig | Lu2021Config | XuShen2022Config,
        neighbors: float,
    ) -> None:
        super().__init__()
        choices = config.backend, neighbors, config.precision
        self.convolution = ContinuousConvolution(width_in, width_out, basis, *choices)
        self.linear = nn.Linear(width_in, width_out)
        self.residual = config.residual and width_in == width_out

    def forward(self, features: Tensor, pairs: Neighborhood) -> Tensor:
        """``(N, C_in)`` features before their ReLU → ``(N, C_out)``, before the next."""
        active = torch.relu(features)
        mixed = self.convolution(active, pairs) + self.linear(active)
        return mixed + features if self.residual else mixed


def kernel_bases(
    config: CconvModelConfig | Lu2021Config | XuShen2022Config, diameter: float, radius: float
) -> tuple[KernelBasis, KernelBasis]:
    """The bases of kernels over particles and over walls, within R = ``radius``, m, of particles of a diameter, m."""
    if config.kernel == "lattice":
        basis = LatticeBasis(radius, config.kernel_size)
        return basis, basis
    around = (RadialBasis.around_contact(diameter, radius, touching) for touching in (diameter, 0.5 * diameter))
    return tuple(around)


def later_layers(
    config: CconvModelConfig | Lu2021Config | XuShen2022Config, width_in: int, basis: KernelBasis, neighbors: float
) -> nn.ModuleList:
    """Hidden layers after the first, and the output."""
    widths = [width_in] + [config.width] * (config.layers - 1) + [3]
    layers = nn.ModuleList(MixingLayer(a, b, basis, config, neighbors) for a, b in itertools.pairwise(widths))
    output = layers[-1]
    with torch.no_grad():
        output.convolution.weight.mul_(_OUTPUT_START)
        output.linear.weight.mul_(_OUTPUT_START)
        output.linear.bias.zero_()
    return layers


def expected_neighbors(radius: float, diameter: float) -> float:
    """Neighbours within ``radius``, m, of a particle in a settled bed; only the scale of first weights follows."""
    return 8.0 * _SOLID_FRACTION * (radius / diameter) ** 3


def expected_points(radius: float, diameter: float, spacing: float) -> float:
    """Wall points, ``spacing`` diameters apart, within ``radius``, m, of a particle that touches the wall."""
    return math.pi * (radius**2 - (0.5 * diameter) ** 2) / (spacing * diameter) ** 2


def pace(scene: Scene) -> float:
    """What turns a velocity, m/s, into the network's unit."""
    return _FRAMES * scene.frame_interval / scene.filling.diameter


class ContinuousConvolutionNetwork(NewtonSurrogate):
    """The CCNN of the founding paper, and its relatives by config; a = a_pp + a_pw, then Newton.

    *Particle branch.* Layer 1 joins a convolution over the neighbours' (v*, 1) and a linear map of v*, ``width/2``
    each; further hidden layers and the output are :class:`MixingLayer`.

    *Wall branch.* Layer 1 joins a linear map of v*, a convolution of the wall's normals and one of its velocities,
    ``width/2`` each; its later layers convolve over the particles. It exists for particles closer than R to a wall
    and sees only them; the others have a_pw = 0. With ``boundary.kind = analytic`` the sources are the closest wall
    points; the gap (in d) joins the normals and the slip velocity the wall's velocities. A boundary feature that is
    switched off takes its convolution with it; without normals, a constant 1 stands for the wall's presence.

    With ``pair_branch = antisymmetric`` the last layer of the particle branch is an `AntisymmetricLayer`: Σ a_pp = 0 to
    rounding, whatever the weights; the window of the convolution takes the place of the fading.

    A branch's output fades to zero where its nearest neighbour, or the wall, reaches the edge of R
    (`neighborhood.nearness`), whatever its linear maps and biases say: a sphere that sees
    nothing flies ballistically.

    Velocities enter in d per 5 frames (m/s for 50 mm and 10 ms), normals as they are. Outputs count
    ``output_scale_diameters`` diameters a frame squared: a = output · output_scale d / Δt². The map does not depend on
    where the scene lies, but it does on its axes.

    Args:
        config: widths, kernel, R, update.
        boundary: how walls are seen.
        scene: for the particles' diameter, and whether there are walls at all.

    Raises:
        ValueError: an unknown kernel, boundary kind, backend, precision or update, or an impossible size.
    """

    def __init__(self, config: CconvModelConfig | XuShen2022Config, boundary: BoundaryConfig, scene: Scene) -> None:
        super().__init__(config.update)
        check_model(config)
        diameter = scene.filling.diameter
        check_radius(config, diameter, scene.period)
        if boundary.kind not in KINDS:
            raise ConfigError(f"boundary.kind={boundary.kind} is not for {config.name}; choose {' or '.join(KINDS)}")
        self.config, self.boundary = config, boundary
        self.diameter, self.radius = diameter, given_or(config.radius_m, config.radius_diameters, diameter)
        self.pair_basis, self.wall_basis = kernel_bases(config, diameter, self.radius)
        half, neighbors = config.width // 2, expected_neighbors(self.radius, diameter)

        def convolution(width_in: int, basis: KernelBasis, count: float) -> ContinuousConvolution:
            return ContinuousConvolution(width_in, half, basis, config.backend, count, config.precision)

        self.pair_input = convolution(4 if config.constant_input else 3, self.pair_basis, neighbors)
        self.pair_linear = nn.Linear(3, half)
        self.pair_bias = nn.Parameter(torch.zeros(half))
        self.pair_layers = later_layers(config, 2 * half, self.pair_basis, neighbors)
        self.conserves = isinstance(config, CconvModelConfig) and config.pair_branch == "antisymmetric"
        if self.conserves:
            self.pair_layers[-1] = AntisymmetricLayer(
                self.pair_layers[-1].linear.in_features, 3, self.pair_basis, config.backend, neighbors
            )
            with torch.no_grad():
                self.pair_layers[-1].convolution.weight.mul_(_OUTPUT_START)

        self.has_walls = boundary.kind != "none" and scene.needs.walls
        if self.has_walls:
            analytic = boundary.kind == "analytic"
            seen = 1.0 if analytic else expected_points(self.radius, diameter, boundary.spacing)
            shape = (3 if boundary.normal else 1) + analytic
            self.wall_linear = nn.Linear(3, half)
            self.wall_normal = convolution(shape, self.wall_basis, seen)
            self.wall_velocity = convolution(6 if analytic else 3, self.wall_basis, seen) if boundary.velocity else None
            inputs = 3 if boundary.velocity else 2
            self.wall_bias = nn.Parameter(torch.zeros((inputs - 1) * half))
            self.wall_layers = later_layers(config, inputs * half, self.pair_basis, neighbors)

    def acceleration(self, position: Tensor, velocity: Tensor, scene: Scene, time: float) -> Tensor:
        return self.accelerations(position, velocity, scene, time)[0]

    def accelerations(self, position: Tensor, velocity: Tensor, scene: Scene, time: float) -> tuple[Tensor, Tensor]:
        given = velocity
        if self.config.backend == "fused":
            position = position.detach()
        pairs = particle_neighborhood(self.pair_basis, position, scene.period)
        inputs = velocity = velocity * pace(scene)
        if self.config.constant_input:
            inputs = torch.cat((velocity, torch.ones_like(velocity[:, :1])), dim=1)
        seen = self.pair_input(inputs, pairs) + self.pair_bias
        features = torch.cat((seen, self.pair_linear(velocity)), dim=1)
        for layer in self.pair_layers:
            features = layer(features, pairs)
        if not self.conserves:  # a factor of each particle would part what i gives j from what j gives i
            features = pairs.nearness(self.diameter)[:, None] * features
        output = of_pairs = features
        if self.has_walls and scene.walls:
            wall = self._see_walls(position, given, scene, time)
            if len(wall.near):
                fade = nearness(wall.distance, 0.5 * self.diameter, self.radius)
                of_wall = fade[:, None] * self._wall_branch(velocity[wall.near], pairs, wall)
                output = output.index_add(0, wall.near, of_wall)
        unit = self.config.output_scale_diameters * self.diameter / scene.frame_interval**2
        return output * unit, of_pairs * unit

    def _see_walls(self, position: Tensor, velocity: Tensor, scene: Scene, time: float) -> WallPairs:
        """What particles of a velocity, m/s, see of the walls; velocities of walls in the network's unit."""
        if self.boundary.kind == "analytic":
            seen = see_contacts(position, velocity, scene, time, self.radius)
        else:
            seen = self._see_spheres(position, scene, time)
        unit = pace(scene)
        return replace(seen, velocity=unit * seen.velocity, slip=None if seen.slip is None else unit * seen.slip)

    def _see_spheres(self, position: Tensor, scene: Scene, time: float) -> WallPairs:
        return see_spheres(position, scene, time, self.radius, self.boundary.spacing * scene.filling.diameter)

    def _wall_branch(self, velocity: Tensor, pairs: Neighborhood, wall: WallPairs) -> Tensor:
        """Output of the wall branch, ``(P, 3)``, from the near particles' velocities in the network's unit."""
        features, among = self._wall_input(velocity, wall), pairs.restricted(wall.near)
        for layer in self.wall_layers:
            features = layer(features, among)
        return features

    def _wall_input(self, velocity: Tensor, wall: WallPairs) -> Tensor:
        """Layer 1 of the wall branch, ``(P, 3/2 width)``: own velocity, normals seen, velocities seen."""
        seen = weigh_pairs(self.wall_basis, wall.query, wall.source, wall.relative, len(wall.near), len(wall.normal))
        shape = wall.normal if self.boundary.normal else torch.ones_like(wall.normal[:, :1])
        if wall.gap is not None:
            shape = torch.cat((shape, wall.gap[:, None]), dim=1)
        convolved = [self.wall_normal(shape, seen)]
        if self.wall_velocity is not None:
            if wall.slip is not None:
                convolved.append(self.wall_velocity(torch.cat((wall.velocity, wall.slip), dim=1), seen))
            elif wall.moves:
                convolved.append(self.wall_velocity(wall.velocity, seen))
            else:
                convolved.append(torch.zeros_like(convolved[0]))
        return torch.cat((self.wall_linear(velocity), torch.cat(convolved, dim=1) + self.wall_bias), dim=1)
