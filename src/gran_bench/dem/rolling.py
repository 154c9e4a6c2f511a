"""Rolling resistance of type C: an elastic–plastic spring against relative rolling, off where μ_r = 0.

The history is the elastic moment M on the first particle. It is projected on the contact plane and loaded by
−k_r ω_r Δt, with ω_r the relative angular velocity in that plane, and capped:

    k_r = 2.25 k_n (μ_r R*)²,  k_n = 2 E* √(R* δ),    |M| ≤ μ_r R* F,  F = K δ^{3/2}

Source: Ai, Chen, Rotter & Ooi (2011), Powder Technology 206, model C (the elastic–plastic spring without its dashpot;
the load is the elastic one, so that a collision's damping does not resist rolling).
"""

from __future__ import annotations

import numpy as np

from gran_bench.state import FloatArray


def rolling_moment(
    moment: FloatArray,
    spin: FloatArray,
    normal: FloatArray,
    overlap: FloatArray,
    effective_radius: FloatArray,
    effective_modulus: float,
    coefficient: float,
    time_step: float,
) -> FloatArray:
    """Moment on the first particle of each contact after a step, which is also its new history, ``(M, 3)`` N m.

    Args:
        moment: ``(M, 3)`` history, N m; zero for a new contact.
        spin: ``(M, 3)`` angular velocity of the first relative to the second, rad/s.
        normal: ``(M, 3)`` unit vectors.
        overlap: ``(M,)`` m.
        effective_radius: ``(M,)`` R*, m.
        effective_modulus: E*, Pa.
        coefficient: μ_r, −.
        time_step: s.
    """
    contact_radius = np.sqrt(effective_radius * overlap)
    stiffness = 2.25 * 2.0 * effective_modulus * contact_radius * (coefficient * effective_radius) ** 2
    limit = coefficient * effective_radius * 4.0 / 3.0 * effective_modulus * contact_radius * overlap
    rolling = spin - np.einsum("mk,mk->m", spin, normal)[:, None] * normal
    moment = moment - np.einsum("mk,mk->m", moment, normal)[:, None] * normal
    moment = moment - (stiffness * time_step)[:, None] * rolling
    size = np.linalg.norm(moment, axis=1)
    return moment * np.where(size > limit, limit / np.maximum(size, np.finfo(float).tiny), 1.0)[:, None]
