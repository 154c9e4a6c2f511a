"""What a contact remembers: an elastic force that turns with the contact, unloads with it, and gives in to Coulomb."""

from __future__ import annotations

import numpy as np
import pytest

from gran_bench.dem.contact import ContactLaw, contact_force
from gran_bench.scene import Material

OVERLAP = 1e-3  # m


def respond(
    history, *, normal=(1.0, 0.0, 0.0), overlap=OVERLAP, before=OVERLAP, friction=50.0, restitution=1.0, **slip
):
    """Tangential force and new history of one contact, ``(3,)`` N each."""
    material = Material(1e7, 0.3, 2500.0, restitution, friction)
    contact = contact_force(
        ContactLaw.between(material, material),
        normal=np.array([normal]),
        overlap=np.array([overlap]),
        effective_radius=np.array([0.0125]),
        effective_mass=np.array([0.08]),
        velocity=np.array([slip.get("velocity", (0.0, 0.0, 0.0))]),
        velocity_gain=np.zeros((1, 3)),
        surface_spin=np.zeros((1, 3)),
        history=np.array([history], float),
        overlap_before=np.array([before]),
        time_step=slip.get("time_step", 0.0),
    )
    n = np.array(normal)
    return contact.force[0] - (contact.force[0] @ n) * n, contact.history[0]


def test_it_turns_with_the_contact_plane_and_keeps_its_length():
    angle = 0.3
    normal = (np.cos(angle), np.sin(angle), 0.0)
    _, history = respond((0.0, 2.0, 1.0), normal=normal)
    assert history @ np.array(normal) == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.norm(history) == pytest.approx(np.sqrt(5.0))


@pytest.mark.parametrize(("overlap", "share"), [(0.25 * OVERLAP, 0.5), (OVERLAP, 1.0), (2.0 * OVERLAP, 1.0)])
def test_it_falls_with_the_contact_radius_but_does_not_rise_with_it(overlap, share):
    _, history = respond((0.0, 1.0, 0.0), overlap=overlap)
    assert history == pytest.approx([0.0, share, 0.0])


def test_it_is_loaded_by_the_slip_of_a_step():
    # k_t = 8 G* √(R* δ), against the slip.
    shear_modulus = 1e7 / (2.0 * 1.3)
    stiffness = 8.0 * shear_modulus / (2.0 * 1.7) * np.sqrt(0.0125 * OVERLAP)
    _, history = respond((0.0, 0.0, 0.0), velocity=(0.0, 0.1, 0.0), time_step=1e-4)
    assert history == pytest.approx([0.0, -stiffness * 1e-5, 0.0])


def test_a_new_contact_remembers_nothing():
    _, history = respond((0.0, 5.0, 0.0), before=0.0)
    assert not history.any()


def test_a_slipping_contact_carries_the_coulomb_force_and_scales_its_elastic_part_alike():
    force, history = respond((0.0, 1e3, 0.0), friction=0.3)
    stiffness = 4.0 / 3.0 * 1e7 / (2.0 * 0.91) * np.sqrt(0.0125)
    assert np.linalg.norm(force) == pytest.approx(0.3 * stiffness * OVERLAP**1.5)
    assert history == pytest.approx(force)


def test_damping_counts_towards_the_limit_but_is_not_remembered():
    sliding = {"velocity": (0.0, 0.5, 0.0), "friction": 0.3, "restitution": 0.5}
    force, history = respond((0.0, -0.5, 0.0), **sliding)
    still, _ = respond((0.0, -1e3, 0.0), friction=0.3, restitution=0.5)
    assert np.linalg.norm(force) == pytest.approx(np.linalg.norm(still))
    assert np.linalg.norm(history) < 0.9 * np.linalg.norm(force)
