"""What a stretch does where lists are made anew, as Python calls it (jitted).

It is compiled apart from the loop of steps, so that two processes can share the work (compiling.py).
"""

from __future__ import annotations

from gran_bench.dem.bodies import rename
from gran_bench.dem.contact_list import list_contacts, touching_contacts
from gran_bench.dem.kernel import entry
from gran_bench.dem.wall_list import list_wall_contacts


@entry(nogil=True)
def search(sphere, bounds, chunk, stop, walls, evaluation, skin, period, first, second, known, rolling):
    """Lists of the pairs and walls that spheres of ``chunk … stop − 1`` may touch, with what they remember.

    Args:
        sphere: ``(N + 2, 4)`` x, y, z, r, m.
        bounds: ``(C + 1,)`` first particle of each chunk.
        chunk, stop: range of chunks.
        walls: ``(steps + 1, W, 21)`` poses.
        evaluation: number of the force evaluation that these positions are for, from 1.
        skin: m.
        period: of y, m; 0 for none.
        first, second, known: ``(C,)``, ``(C,)``, ``(C, 7)`` contacts by row that touched in the last evaluation.
        rolling: whether rolling moments are remembered.

    Returns:
        As :func:`contact_list.list_contacts` and :func:`wall_list.list_wall_contacts`.
    """
    count, before = len(sphere) - 2, evaluation - 1
    pair_i, pair_j, start, slot, moment, touched = list_contacts(
        sphere, count, bounds[chunk], bounds[stop], skin, period, first, second, known, before, rolling
    )
    wall_i, wall_w, wall_start, wall_slot, wall_moment, wall_touched = list_wall_contacts(
        sphere, bounds, chunk, stop, walls, before, 0.5 * skin, first, second, known, before, rolling
    )
    return (
        pair_i, pair_j, start, slot, moment, touched,
        wall_i, wall_w, wall_start, wall_slot, wall_moment, wall_touched,
    )  # fmt: skip


@entry(nogil=True)
def touching(
    pair_i, pair_j, start, slot, moment, touched, wall_i, wall_w, wall_start, wall_slot, wall_moment, wall_touched,
    evaluation, order,
):  # fmt: skip
    """The contacts of lists that an evaluation found touching, with what they remember.

    Args:
        pair_i, …, wall_touched: what :func:`search` returned.
        evaluation: its number.
        order: ``(N,)`` particle of each row, to call them by particle; empty to call them by row.
    """
    first, second, known = touching_contacts(
        pair_i, pair_j, slot, moment, touched, wall_i, wall_w, wall_slot, wall_moment, wall_touched, evaluation
    )
    if len(order) > 0:
        rename(first, second, known, order)
    return first, second, known
