"""The two angles of repose: known beds, invariances, validity, and what has no angle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from beds import RADIUS, drum, inclined_bed, resting

from gran_bench.metrics.angle_of_repose import (
    center_of_mass_angles,
    com_angle,
    solid_fractions,
    surface_angle,
    surface_lines,
    topmost_crossing,
)


def angle_series(trajectory, scene):
    surface = surface_angle(trajectory, scene)
    return surface, com_angle(trajectory, scene), surface.lines


def angle_and_line(position, scene=None):
    """Angle in degrees and the line of one bed."""
    line = surface_lines(position[None], np.full(len(position), RADIUS), scene or drum())[0]
    return np.degrees(line.angle), line


def center_angle(position, scene=None):
    return np.degrees(center_of_mass_angles(position[None], np.full(len(position), RADIUS), scene or drum())[0])


@pytest.mark.parametrize("angle", [-20.0, 0.0, 12.5, 35.0, 60.0])
def test_an_inclined_plane_has_its_angle(angle):
    found, line = angle_and_line(inclined_bed(angle))
    assert line.valid
    assert line.filled == 1.0
    assert found == pytest.approx(angle, abs=1.0)
    assert center_angle(inclined_bed(angle)) == pytest.approx(angle, abs=1.0)


def test_turning_the_bed_about_the_axis_turns_both_angles_by_as_much():
    bed, turn = inclined_bed(20.0, seed=3), np.radians(17.0)
    # The bed climbs towards −x, so a positive turn takes −z into −x.
    matrix = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    turned = bed @ matrix.T
    assert center_angle(turned) - center_angle(bed) == pytest.approx(17.0, abs=1e-6)
    assert angle_and_line(turned)[0] - angle_and_line(bed)[0] == pytest.approx(17.0, abs=1e-2)


def test_the_mirrored_bed_in_a_drum_that_turns_backwards_has_the_same_angles():
    bed = inclined_bed(30.0)
    mirrored = bed * [-1.0, 1.0, 1.0]
    assert angle_and_line(mirrored, drum(-30.0))[0] == pytest.approx(angle_and_line(bed)[0], abs=1e-9)
    assert center_angle(mirrored, drum(-30.0)) == pytest.approx(center_angle(bed), abs=1e-9)
    assert angle_and_line(mirrored, drum(30.0))[0] == pytest.approx(-30.0, abs=1.0)


def test_the_order_and_the_place_along_the_axis_do_not_matter():
    bed = inclined_bed(30.0)
    shuffled = np.random.default_rng(0).permutation(bed)
    shuffled[:, 1] += 0.2
    assert angle_and_line(shuffled)[0] == pytest.approx(angle_and_line(bed)[0], abs=1e-9)


def test_the_centre_of_mass_weighs_spheres_by_their_volume():
    scene, position = drum(), np.array([[[0.0, 0.0, -0.4], [-0.4, 0.0, 0.0]]])
    angle = center_of_mass_angles(position, np.array([0.02, 0.04]), scene)[0]
    assert np.degrees(angle) == pytest.approx(np.degrees(np.arctan(8.0)))


@pytest.mark.parametrize("off", [-15.0, -5.0, 5.0, 15.0])
def test_the_iteration_finds_the_surface_from_wherever_it_starts(off):
    bed = inclined_bed(30.0)
    start = np.radians([30.0 + off])
    line = surface_lines(bed[None], np.full(len(bed), RADIUS), drum(), start)[0]
    assert np.degrees(line.angle) == pytest.approx(angle_and_line(bed)[0], abs=0.1)


def test_gravity_along_another_direction_gives_the_same_angle():
    bed = inclined_bed(25.0)
    sideways = replace(drum(), gravity=(9.81, 0.0, 0.0))  # down is +x, so the bed climbs towards −z
    turned = np.stack((-bed[:, 2], bed[:, 1], bed[:, 0]), axis=1)
    assert angle_and_line(turned, sideways)[0] == pytest.approx(angle_and_line(bed)[0], abs=1e-9)
    assert center_angle(turned, sideways) == pytest.approx(center_angle(bed), abs=1e-9)


def test_slabs_fill_the_bins_with_exactly_the_spheres_volume():
    rng = np.random.default_rng(1)
    radius = rng.uniform(0.01, 0.03, 500)
    s, w = rng.uniform(-0.27, 0.27, 500), rng.uniform(-0.45, 0.45, 500)  # those larger than the scene's are cut
    _, _, fraction = solid_fractions(s, w, radius, drum())
    assert fraction.shape[0] == 12
    volume = fraction.sum() * 0.05 * 0.0125 * 1.0
    assert volume == pytest.approx(4 / 3 * np.pi * (radius**3).sum(), rel=1e-12)


def test_a_sphere_counts_in_the_column_of_its_centre():
    s, w = np.array([0.049]), np.array([0.0])
    middle, _, fraction = solid_fractions(s, w, np.array([0.025]), drum())
    assert middle[fraction.sum(axis=1) > 0] == pytest.approx([0.025])


def test_a_coarse_grained_sphere_counts_in_the_columns_that_it_fills():
    s, w = np.array([0.025]), np.array([0.0])
    middle, height, fraction = solid_fractions(s, w, np.array([0.0625]), drum())
    assert middle[fraction.sum(axis=1) > 0] == pytest.approx([-0.025, 0.025, 0.075])
    volume = fraction.sum(axis=1)[fraction.sum(axis=1) > 0] * 0.05 * 0.0125
    # Of the sphere beyond 25 mm from its middle: a cap of 37.5 mm on either side; discs of a bin's width hit it to 1 %.
    cap = np.pi / 3 * 0.0375**2 * (3 * 0.0625 - 0.0375)
    assert volume == pytest.approx([cap, 4 / 3 * np.pi * 0.0625**3 - 2 * cap, cap], rel=0.01)
    assert np.abs((fraction.sum(axis=0) * height).sum()) < 1e-12  # as much above the middle as below


def test_one_slab_of_one_sphere():
    # The lowest quarter of a sphere that starts on an edge: π h² (3r − h)/3 with h = 12.5 mm.
    _, height, fraction = solid_fractions(np.array([0.01]), np.array([0.025]), np.array([0.025]), drum())
    lowest = fraction[:, np.isclose(height, 0.00625)].max() * 0.05 * 0.0125
    assert lowest == pytest.approx(np.pi * 0.0125**2 * (0.075 - 0.0125) / 3, rel=1e-12)


def test_the_topmost_crossing_is_interpolated_and_ignores_what_lies_deeper():
    heights = np.arange(6) * 0.01
    fraction = np.array(
        [
            [0.6, 0.1, 0.6, 0.5, 0.1, 0.0],  # a hole under the surface; crosses 0.3 halfway from 0.03 to 0.04
            [0.6, 0.6, 0.6, 0.6, 0.6, 0.6],  # no surface inside the drum
            [0.2, 0.2, 0.1, 0.0, 0.0, 0.0],  # never dense
        ]
    )
    found = topmost_crossing(fraction, heights)
    assert found[0] == pytest.approx(0.035)
    assert np.isnan(found[1:]).all()


def test_a_bed_without_a_straight_surface_is_invalid():
    bed = inclined_bed(0.0)
    heap = bed[(bed[:, 2] < -0.2) | (np.abs(bed[:, 0]) < 0.1)]
    line = angle_and_line(heap)[1]
    assert not line.valid
    assert line.residual > 0.5 * 2 * RADIUS


def test_a_bed_that_fills_few_columns_is_invalid():
    bed = inclined_bed(0.0)
    line = angle_and_line(bed[np.abs(bed[:, 0]) < 0.2])[1]
    assert not line.valid
    assert line.filled == pytest.approx(8 / 12)


def test_no_spheres_have_no_angle():
    line = surface_lines(np.zeros((1, 0, 3)), np.zeros(0), drum(), start_angles=np.zeros(1))[0]
    assert not line.valid
    assert np.isnan(line.angle)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_state_that_is_not_finite_has_no_angle_and_is_left_out_with_a_note(bad):
    scene = drum()
    trajectory = resting(scene, inclined_bed(30.0), frames=20)
    trajectory.position[4, 7, 0] = bad
    surface, center, _ = angle_series(trajectory, scene)
    for series in (surface, center):
        assert np.flatnonzero(~series.valid).tolist() == [4]
        assert "1 of 20 states" in series.mean().note


def test_a_state_whose_surface_is_invalid_has_only_the_other_angle():
    scene, bed = drum(), inclined_bed(0.0)
    heap = bed[(bed[:, 2] < -0.2) | (np.abs(bed[:, 0]) < 0.1)]
    surface, center, lines = angle_series(resting(scene, heap, frames=1), scene)
    assert np.isfinite(lines[0].angle)
    assert not surface.valid.any()
    assert "no straight surface" in surface.mean().note
    assert center.valid.all()


def test_an_infinite_centre_has_no_angle_even_where_its_arctangent_exists():
    oblique = replace(drum(), gravity=(7.0, 0.0, -7.0))
    position = np.array([[[0.1, 0.0, -0.3]], [[-np.inf, 0.0, -0.3]]])
    angles = center_of_mass_angles(position, np.full(1, RADIUS), oblique)
    assert np.isfinite(angles).tolist() == [True, False]


def test_at_and_above_the_critical_speed_both_angles_are_undefined_whatever_the_fit_says():
    bed = inclined_bed(30.0)
    for speed in (drum().critical_speed_rpm, 50.0, -60.0):
        scene = drum(speed)
        surface, center, lines = angle_series(resting(scene, bed, frames=3), scene)
        assert lines[0].valid  # the fit alone would have given a number
        for series in (surface, center):
            assert not series.valid.any()
            assert "critical speed" in series.mean().note
    below = drum(43.0)
    assert angle_series(resting(below, bed, frames=3), below)[0].mean().defined
