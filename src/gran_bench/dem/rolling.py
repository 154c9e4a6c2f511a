"""Rolling resistance of type C: an elastic–plastic spring with a dashpot against relative rolling, off where μ_r = 0.

The moment on the first particle is spring and dashpot together, limited; ω_r is the relative angular velocity in the
contact plane:

    M = M_k − C_r ω_r,    |M| ≤ μ_r R* F,    F = K δ^{3/2}

The elastic part M_k is the history. It is projected on the contact plane, reduced by √(δ/δ_before) when the overlap
shrinks (the spring then softens, and would hand back more than it took), and loaded by −k_r ω_r Δt. Where M reaches
the limit, M and M_k are cut together, as the friction force is (contact.py).

    k_r = 2.25 k_n (μ_r R*)²,    k_n = 2 E* √(R* δ)
    C_r = 2 √(I_r k_r),    1/I_r = 1/(I₁ + m₁ r₁²) + 1/(I₂ + m₂ r₂²),    I = 2/5 m r²

C_r damps critically a sphere that rolls about its contact point with a wall: one that rolling friction has stopped does
not rock. What is left of its speed decays with √(I_r/k_r); what it loses while it rolls is the limit's alone.

Source: Ai, Chen, Rotter & Ooi (2011), Powder Technology 206, 269–282, model C, at the damping ratio η_r = 1, with one
limit for the sum (Luding 2008, Granular Matter 10, 235) by the elastic load, so that damping does not resist rolling.
"""

from __future__ import annotations

import numpy as np

from gran_bench.state import FloatArray

CONTACT_INERTIA = 1.4  # of a sphere about a point of its surface, in m r²


def rolling_stiffness(effective_modulus, coefficient, effective_radius, overlap):
    """k_r = 2.25 k_n (μ_r R*)² with k_n = 2 E* √(R* δ), N m; of numbers or arrays."""
    return 4.5 * effective_modulus * np.sqrt(effective_radius * overlap) * (coefficient * effective_radius) ** 2


def rolling_drag(effective_inertia: FloatArray | float, stiffness: FloatArray | float) -> FloatArray | float:
    """C_r = 2 √(I_r k_r), N m s."""
    return 2.0 * np.sqrt(effective_inertia * stiffness)


def rolling_moment(
    history: FloatArray, spin: FloatArray, normal: FloatArray, overlap: FloatArray, overlap_before: FloatArray,
    effective_radius: FloatArray, effective_inertia: FloatArray, effective_modulus: FloatArray | float,
    coefficient: FloatArray | float, time_step: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Moment on the first particle of each contact after a step, and its new history, both ``(M, 3)`` N m.

    Args:
        history: ``(M, 3)`` elastic moment, N m; zero for a new contact.
        spin: ``(M, 3)`` angular velocity of the first relative to the second, rad/s.
        normal: ``(M, 3)`` unit vectors.
        overlap, overlap_before: ``(M,)`` δ, m, and when the history was stored; 0 for a new contact.
        effective_radius, effective_inertia: ``(M,)`` R*, m, and I_r, kg m².
        effective_modulus, coefficient: E*, Pa, and μ_r, −.
        time_step: s.
    """
    stiffness = rolling_stiffness(effective_modulus, coefficient, effective_radius, overlap)
    load = 4.0 / 3.0 * effective_modulus * np.sqrt(effective_radius * overlap) * overlap
    limit = coefficient * effective_radius * load
    rolling = spin - np.einsum("mk,mk->m", spin, normal)[:, None] * normal
    history = history - np.einsum("mk,mk->m", history, normal)[:, None] * normal
    ratio = np.divide(overlap, overlap_before, out=np.zeros_like(overlap), where=overlap_before > 0)
    history = np.sqrt(np.minimum(1.0, ratio))[:, None] * history - (stiffness * time_step)[:, None] * rolling
    moment = history - rolling_drag(effective_inertia, stiffness)[:, None] * rolling
    size = np.linalg.norm(moment, axis=1)
    scale = np.divide(limit, size, out=np.ones_like(size), where=size > limit)[:, None]
    return scale * moment, scale * history
