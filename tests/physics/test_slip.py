"""Where slip is measured: at the contact point, or with full radii as LAMMPS does; the same in both engines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gran_bench.config import DemConfig, FillingConfig, MaterialConfig, SceneConfig, SizesConfig
from gran_bench.dataset import CaseSpec
from gran_bench.dem.contact import ContactLaw
from gran_bench.dem.simulate import settle, simulate
from gran_bench.scene import build_scene
from gran_bench.state import ParticleState

FULL, POINT = (DemConfig(time_step=2e-4, slip=name) for name in ("full_radius", "contact_point"))


def drum(spread: float = 0.0):
    """100 soft spheres in a drum at 30 rpm; their radii spread by as much."""
    sizes = SizesConfig("uniform", spread=spread) if spread else SizesConfig()
    scene = SceneConfig(
        name="slipping",
        filling=FillingConfig(count=100, settled_speed=0.05, sizes=sizes),
        material=MaterialConfig(youngs_modulus=1e6),
    )
    scene.container.length, scene.rotation.speeds_rpm = 0.2, [30.0]
    return build_scene(scene)


@pytest.mark.parametrize("spread", [0.0, 0.2])
def test_both_engines_measure_the_same_slip(spread):
    scene = drum(spread)
    bed = settle(scene, 0)
    assert (np.ptp(bed.radius) > 0) == bool(spread)
    end = bed.time + 5 * scene.frame_interval
    fast, reference = (simulate(scene, bed, end, dem=replace(FULL, engine=e)).final for e in ("numba", "numpy"))
    assert np.abs(fast.position - reference.position).max() < 1e-10
    assert np.abs(fast.angular_velocity - reference.angular_velocity).max() < 1e-7
    point = simulate(scene, bed, end, dem=POINT).final
    assert np.abs(fast.position - point.position).max() > 1e-6


@pytest.mark.parametrize("radii", [(0.025, 0.025), (0.02, 0.03)])
def test_a_pair_that_turns_as_one_body_slips_by_omega_times_overlap(laboratory, spheres, engine, radii):
    # Two centres a distance d apart that turn about their middle at ω, spins ω too: v = ω d between the centres.
    overlap, speed, step = 1e-3, 10.0, 1e-7
    distance = sum(radii) - overlap
    at, moving = np.array([[-0.5, 0, 0], [0.5, 0, 0]]), np.array([[0, 0, 0.5], [0, 0, -0.5]])
    state = spheres(distance * at, speed * distance * moving, [[0, speed, 0]] * 2, list(radii))
    scene = replace(laboratory(friction=10.0), frame_interval=step)
    law = ContactLaw.between(scene.material, scene.material)
    stiffness = 8.0 * law.effective_shear_modulus * np.sqrt(radii[0] * radii[1] / sum(radii) * overlap)
    for slip, expected in (("contact_point", 0.0), ("full_radius", speed * overlap)):
        dem = DemConfig(engine=engine, time_step=step, slip=slip)
        force = simulate(scene, state, step, dem=dem).final.history.force
        assert np.linalg.norm(force) == pytest.approx(stiffness * step * expected, rel=1e-3, abs=1e-9)


def test_full_radii_keep_the_angular_momentum_of_a_closed_system(laboratory, spheres, engine):
    # The torque's arms end at the contact point all the same.
    scene = replace(laboratory(friction=0.5, restitution=0.5, youngs_modulus=1e6), frame_interval=0.04)
    state = spheres([[0, 0, 0], [0.051, 0.01, 0]], [[1.5, 0, 0.1], [-1.0, 0.2, 0]], [[30, 10, -20], [0, 40, 5]])
    final = simulate(scene, state, 0.04, dem=DemConfig(engine=engine, time_step=1e-4, slip="full_radius")).final

    def turning(state: ParticleState) -> np.ndarray:
        own = 0.4 * state.radius[:, None] ** 2 * state.angular_velocity
        return (np.cross(state.position, state.velocity) + own).sum(axis=0)

    assert turning(final) == pytest.approx(turning(state), abs=1e-14)
    assert not np.allclose(final.angular_velocity, state.angular_velocity)


def test_data_made_with_another_slip_have_another_name():
    scene = drum()
    one, other = (CaseSpec(scene, dem).key for dem in (FULL, POINT))
    assert one != other
    assert one["dem"]["slip"] == "full_radius"
