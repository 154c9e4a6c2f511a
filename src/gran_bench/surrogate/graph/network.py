"""The graph network: encode, pass messages, decode to the acceleration of contacts."""

import torch
from torch import Tensor, nn

from gran_bench.config import GnsConfig
from gran_bench.config.choices import check_radius, given_or
from gran_bench.scene import Scene
from gran_bench.surrogate.graph.edges import frame_graph
from gran_bench.surrogate.graph.messages import EdgeUpdate, perceptron
from gran_bench.surrogate.step import NewtonSurrogate

_FRAMES = 5.0  # velocities count diameters in so many frames: m/s where d = 50 mm and Δt = 10 ms
_GAP = 0.1  # of a diameter, the unit of gaps: an overlap is a few hundredths of a diameter
_OUTPUT_START = 0.1  # first output weights, of their usual size: an untrained network starts near pure gravity


class GraphNetwork(NewtonSurrogate):
    """A graph network simulator with walls as nodes; its output is the acceleration of contacts, then Newton.

    * Encode: h_i = P(v*, 0, 0) of a particle, h_w = P(wall's velocity, normal, 1) of the closest point of a wall, and
      e_ij = P(x_j − x_i, gap) of an edge. Only differences of positions enter.
    * K message steps, each with weights of its own (:mod:`~gran_bench.surrogate.graph.messages`): e_ij ← e_ij + m_ij
      and h_i ← h_i + P(h_i, Σ_j fade_ij m_ij). Wall nodes send and do not change.
    * Decode: a_i = max_j fade_ij · P(h_i) · output_scale d / Δt².

    P are perceptrons with ReLU, with a layer norm at the end but for the decoder. A sphere without an edge has a = 0
    and falls exactly.

    It differs from the source: a state has one velocity, so there is none of the four before; the network adds to
    gravity and does not learn it; edges fade towards their reach; a wall is a node of its closest point in place of
    the distance to a box.

    Velocities enter in d per 5 frames, distances in d, gaps in 0.1 d. The map does not change with the numbering or
    with the place of the scene; it claims nothing under rotation.

    Args:
        config: width, steps, reach, update.
        scene: for the particles' diameter.

    Raises:
        ConfigError: a reach that leaves a contact no room to fade, or of more than half a period.

    Source: Sanchez-Gonzalez et al. (2020), Learning to simulate complex physics with graph networks, ICML; walls after
    Mayr et al. (2021), Boundary graph neural networks for 3D simulations, arXiv 2106.11299.
    """

    def __init__(self, config: GnsConfig, scene: Scene) -> None:
        super().__init__(config.update)
        self.diameter = scene.filling.diameter
        check_radius(config, self.diameter, scene.period)
        self.radius = given_or(config.radius_m, config.radius_diameters, self.diameter)
        self.output_scale = config.output_scale_diameters
        width, layers, steps = config.width, config.layers, config.message_steps

        def normed(width_in: int) -> nn.Sequential:
            return nn.Sequential(perceptron(width_in, width, layers, width), nn.LayerNorm(width))

        self.node_encoder, self.edge_encoder = normed(7), normed(4)
        self.edge_updates = nn.ModuleList(EdgeUpdate(width, layers) for _ in range(steps))
        self.node_updates = nn.ModuleList(normed(2 * width) for _ in range(steps))
        self.decoder = perceptron(width, width, layers, 3)
        with torch.no_grad():
            self.decoder[-1].weight.mul_(_OUTPUT_START)
            self.decoder[-1].bias.zero_()

    def acceleration(self, position: Tensor, velocity: Tensor, scene: Scene, time: float) -> Tensor:
        graph = frame_graph(position, velocity, scene, time, self.radius)
        pace = _FRAMES * scene.frame_interval / self.diameter
        count, walls = len(position), len(graph.normal)
        kind = torch.ones_like(graph.normal[:, :1])
        nodes = torch.cat((velocity * pace, graph.velocity * pace))
        shape = torch.cat((position.new_zeros(count, 4), torch.cat((graph.normal, kind), dim=1)))
        particle, wall = self.node_encoder(torch.cat((nodes, shape), dim=1)).split((count, walls))
        edge = self.edge_encoder(torch.cat((graph.relative, graph.gap[:, None] / _GAP), dim=1))
        for edge_update, node_update in zip(self.edge_updates, self.node_updates, strict=True):
            edge, summed = edge_update(edge, particle, wall, graph)
            particle = particle + node_update(torch.cat((particle, summed), dim=1))
        nearest = position.new_zeros(count).scatter_reduce(0, graph.receiver, graph.fade, "amax")
        unit = self.output_scale * self.diameter / scene.frame_interval**2
        return unit * nearest[:, None] * self.decoder(particle)
