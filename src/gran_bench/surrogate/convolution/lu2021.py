"""One continuous-convolution network that predicts the next position: a relative of the founding article's CCNN."""

import torch
from torch import Tensor, nn

from gran_bench.config import BoundaryConfig, Lu2021Config
from gran_bench.config.choices import check_radius, check_static, given_or
from gran_bench.config.consistency import check_model
from gran_bench.scene import Scene
from gran_bench.surrogate.convolution.boundary import see_spheres
from gran_bench.surrogate.convolution.ccnn import (
    expected_neighbors,
    expected_points,
    kernel_bases,
    later_layers,
    pace,
)
from gran_bench.surrogate.convolution.cconv import ContinuousConvolution
from gran_bench.surrogate.convolution.neighborhood import (
    KernelBasis,
    Neighborhood,
    nearness,
    particle_neighborhood,
    weigh_pairs,
)
from gran_bench.surrogate.step import FrameState, Surrogate, wrap


class Lu2021Network(Surrogate):
    """Positions, velocities and static boundary points in, the next position out; one network for both.

    v* = vⁿ + g Δt;  x* = xⁿ + Δt v*;  xⁿ⁺¹ = x* + Δx(x*, v*);  vⁿ⁺¹ = (xⁿ⁺¹ − xⁿ)/Δt.

    Layer 1 joins a linear map of v*, a convolution over the neighbours' (v*, 1) and a convolution over the points of
    the walls, with their normals, ``width/2`` features each. All later layers, the output included, convolve over the
    particles (`MixingLayer`). One unit of output is ``output_scale_diameters`` d.

    *A static boundary* has positions and normals and no velocity. In a drum that turns, its points stay where they
    are. So the network cannot know how fast a wall moves, or that it moves at all: from a bed at rest, a drum at 60 rpm
    and one at rest have the same next frame. It can only tell from the particles' velocities, once they turn with it.

    *Free flight* is exact: Δx fades to zero where the nearest neighbour, and the wall, reach the edge of R.

    The article predicts positions of drum and hopper with one such network. What follows is chosen here, most of it a
    key of the model: widths, layers, R, window and lattice (as of Ummenhofer et al. 2020, whose layer it is), the
    constant input, the residual, the unit of output, a start from free flight instead of xⁿ, and the fading.

    Args:
        config: widths, kernel, R.
        boundary: ``spheres`` without velocity, or ``none``.
        scene: for the particles' diameter, and whether there are walls at all.

    Raises:
        ConfigError: walls with a velocity, or an impossible size.

    Source: Lu, Gao, Dietiker, Shahnam & Rogers (2021), Machine learning accelerated discrete element modeling of
    granular flows, Chemical Engineering Science 245, 116832.
    """

    velocity_kind = "mean"

    def __init__(self, config: Lu2021Config, boundary: BoundaryConfig, scene: Scene) -> None:
        super().__init__()
        diameter = scene.filling.diameter
        check_model(config)
        check_radius(config, diameter, scene.period)
        check_static(config, boundary)
        self.config, self.boundary, self.diameter = config, boundary, diameter
        self.radius = given_or(config.radius_m, config.radius_diameters, diameter)
        self.pair_basis, self.wall_basis = kernel_bases(config, diameter, self.radius)
        half, neighbors = config.width // 2, expected_neighbors(self.radius, diameter)
        features = 4 if config.constant_input else 3
        self.linear = nn.Linear(3, half)

        def convolution(width_in: int, basis: KernelBasis, count: float) -> ContinuousConvolution:
            return ContinuousConvolution(width_in, half, basis, config.backend, count, config.precision)

        self.pair_input = convolution(features, self.pair_basis, neighbors)
        self.pair_bias = nn.Parameter(torch.zeros(half))
        self.has_walls = boundary.kind != "none" and scene.needs.walls
        if self.has_walls:
            seen = expected_points(self.radius, diameter, boundary.spacing)
            shape = 3 if boundary.normal else 1
            self.wall_input = convolution(shape, self.wall_basis, seen)
            self.wall_bias = nn.Parameter(torch.zeros(half))
        self.layers = later_layers(config, (2 + self.has_walls) * half, self.pair_basis, neighbors)

    def advance(self, state: FrameState, scene: Scene, time: float) -> FrameState:
        interval, velocity = scene.frame_interval, state.velocity
        if scene.needs.gravity:
            velocity = velocity + velocity.new_tensor(scene.gravity) * interval
        guess = wrap(state.position + interval * velocity, scene.period)
        if torch.isfinite(guess).all() and torch.isfinite(velocity).all():
            correction = self.correction(guess, velocity, scene, time)
        else:  # neighbours of nowhere do not exist: the failure shows
            correction = torch.full_like(velocity, torch.nan)
        # (xⁿ⁺¹ − xⁿ)/Δt without the rounding of positions, which would be 1e-5 m/s a frame.
        velocity = velocity + correction / interval
        return FrameState(wrap(guess + correction, scene.period), velocity)

    def correction(self, position: Tensor, velocity: Tensor, scene: Scene, time: float) -> Tensor:
        """Δx at x* (m) and v* (m/s), of the frame from ``time``, s: ``(N, 3)`` m."""
        if self.config.backend == "fused":
            position = position.detach()
        pairs = particle_neighborhood(self.pair_basis, position, scene.period)
        inputs = velocity = velocity * pace(scene)
        if self.config.constant_input:
            inputs = torch.cat((velocity, torch.ones_like(velocity[:, :1])), dim=1)
        near = pairs.nearness(self.diameter)
        parts = [self.linear(velocity), self.pair_input(inputs, pairs) + self.pair_bias]
        if self.has_walls:
            seen, near = self._see_walls(position, near, scene, time)
            parts.append(seen + self.wall_bias)
        features = torch.cat(parts, dim=1)
        for layer in self.layers:
            features = layer(features, pairs)
        return near[:, None] * features * (self.config.output_scale_diameters * self.diameter)

    def _see_walls(self, position: Tensor, near: Tensor, scene: Scene, time: float) -> tuple[Tensor, Tensor]:
        """The convolution over the wall points, ``(N, width/2)``, and how near a neighbour or a wall is, ``(N,)``."""
        seen = position.new_zeros(len(position), self.config.width // 2)
        if not scene.walls:
            return seen, near
        wall = see_spheres(position, scene, time, self.radius, self.boundary.spacing * self.diameter)
        if not len(wall.near):
            return seen, near
        points = wall.normal if self.boundary.normal else torch.ones_like(wall.normal[:, :1])
        found: Neighborhood = weigh_pairs(
            self.wall_basis, wall.query, wall.source, wall.relative, len(wall.near), len(points)
        )
        touching = nearness(wall.distance, 0.5 * self.diameter, self.radius)
        beside = torch.zeros_like(near).index_add(0, wall.near, touching)
        return seen.index_add(0, wall.near, self.wall_input(points, found)), torch.maximum(near, beside)
