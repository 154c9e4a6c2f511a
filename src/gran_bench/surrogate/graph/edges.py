"""The graph of a frame: an edge from each particle and each closest wall point within reach."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gran_bench.neighbors import cell_neighbors
from gran_bench.scene import Scene
from gran_bench.surrogate.convolution.boundary import see_contacts
from gran_bench.surrogate.step import minimum_image


@dataclass(frozen=True)
class FrameGraph:
    """N particles, W wall nodes after them, and E edges sorted by receiver; each pair has an edge either way.

    A wall node is the closest point of one wall to one particle, which alone receives from it.
    """

    receiver: Tensor  # (E,) int64, a particle
    sender: Tensor  # (E,) int64, a particle, or N + w for wall node w
    relative: Tensor  # (E, 3) d, sender − receiver
    gap: Tensor  # (E,) d, between the surfaces; negative where they overlap
    fade: Tensor  # (E,) share of its message that arrives: 1 in contact, falling to 0 at the reach
    normal: Tensor  # (W, 3) of the wall, towards its particle
    velocity: Tensor  # (W, 3) m/s, of the wall's material, mean over the frame


def frame_graph(position: Tensor, velocity: Tensor, scene: Scene, time: float, reach: float) -> FrameGraph:
    """The graph of particles at ``(N, 3)`` m and of the walls at the end of the frame from ``time``, s.

    An edge joins surfaces whose gap is less than ``reach − d``. Up to half of this gap its message arrives in full,
    from there on it fades: with s = 2 − 2 gap/(reach − d) within [0, 1], s² (3 − 2s) of it arrive. So no edge appears
    with a jump.

    Args:
        position, velocity: ``(N, 3)`` m and m/s; relative vectors, gaps and fades are differentiable in positions.
        reach: largest distance of two centres, m; at most half a period.

    Raises:
        ValueError: a period that is shorter than twice the reach.
    """
    count, d = len(position), scene.filling.diameter
    centres = position.detach().double().cpu().numpy()
    query, source = (
        torch.from_numpy(i).to(position.device) for i in cell_neighbors(centres, centres, reach, scene.period)
    )
    others = torch.nonzero(query != source)[:, 0]
    receiver, sender = query.index_select(0, others), source.index_select(0, others)
    apart = minimum_image(position.index_select(0, sender) - position.index_select(0, receiver), scene.period)
    relative, normal, moving = apart / d, position.new_zeros(0, 3), position.new_zeros(0, 3)
    gap = torch.linalg.vector_norm(relative, dim=1) - 1.0
    if scene.walls:
        wall = see_contacts(position, velocity, scene, time, reach - 0.5 * d)
        normal, moving = wall.normal, wall.velocity
        receiver = torch.cat((receiver, wall.near.index_select(0, wall.query)))
        sender = torch.cat((sender, count + wall.source))
        relative, gap = torch.cat((relative, wall.relative / d)), torch.cat((gap, wall.gap))
        order = torch.argsort(receiver, stable=True)
        receiver, sender = receiver.index_select(0, order), sender.index_select(0, order)
        relative, gap = relative.index_select(0, order), gap.index_select(0, order)
    left = (2.0 - 2.0 * gap / (reach / d - 1.0)).clamp(0.0, 1.0)
    fade = left * left * (3.0 - 2.0 * left)
    return FrameGraph(receiver, sender, relative, gap, fade, normal, moving)
