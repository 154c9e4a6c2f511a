"""Sizes of spheres: distributions by number and by mass, and radii that are listed."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from gran_bench.config import DatasetConfig, DemConfig
from gran_bench.config.rules import ConfigError
from gran_bench.dataset import (
    from_document,
    own_case,
    to_document,
)
from gran_bench.dem.simulate import simulate
from gran_bench.scene import (
    Filling,
    SceneError,
    Sizes,
)
from gran_bench.scene.filling import apportioned
from gran_bench.shipped import shipped_scene

# ---- sizes ---------------------------------------------------------------------------------------------------


def test_listed_sizes_come_in_exact_shares_in_random_order():
    sizes = Sizes("listed", (1.0, 0.5, 2.0), (0.5, 0.3, 0.2))
    one, other = (sizes.sample(101, np.random.default_rng(seed)) for seed in (0, 1))
    assert [np.count_nonzero(one == f) for f in (1.0, 0.5, 2.0)] == [51, 30, 20]
    assert np.array_equal(np.sort(one), np.sort(other))
    assert not np.array_equal(one, other)


def test_continuous_sizes_are_the_quantiles_of_their_distribution():
    rng = np.random.default_rng(0)
    uniform = np.sort(Sizes("uniform", spread=0.2).sample(1000, rng))
    assert uniform == pytest.approx(0.8 + 0.4 * (np.arange(1000) + 0.5) / 1000)
    lognormal = Sizes("lognormal", spread=0.25)
    logs = np.log(lognormal.sample(20_000, rng)) / 0.25
    assert np.abs(logs).max() < 2.0  # cut at two standard deviations
    assert logs.mean() == pytest.approx(0.0, abs=1e-9)
    assert logs.std() == pytest.approx(0.8796, abs=1e-3)  # of a normal distribution cut there
    assert (lognormal.smallest, lognormal.largest) == pytest.approx((math.exp(-0.5), math.exp(0.5)))


def mass_between(factors: np.ndarray, low: float, high: float) -> float:
    """Share of the mass of spheres of such diameters."""
    mass = factors**3
    return float(mass[(low <= factors) & (factors < high)].sum() / mass.sum())


SIEVE = Sizes("histogram", edges=(0.5, 0.8, 1.0, 2.0), fractions=(0.2, 0.3, 0.5), by="mass")


def test_a_sieve_curve_comes_out_as_it_went_in():
    factors = SIEVE.sample(20_000, np.random.default_rng(0))
    assert [mass_between(factors, *bin) for bin in pairwise(SIEVE.edges)] == pytest.approx(SIEVE.fractions, abs=2e-4)
    # Uniform by mass within a bin: half of its mass lies below its middle.
    assert mass_between(factors, 1.0, 1.5) == pytest.approx(0.25, abs=2e-4)
    assert (SIEVE.smallest, SIEVE.largest) == (0.5, 2.0)
    # Most of the spheres are small ones, though they hold a fifth of the mass.
    assert np.mean(factors < 0.8) > 0.5


def test_a_histogram_by_number_has_exact_numbers_in_its_bins():
    sizes = replace(SIEVE, by="number", fractions=(0.2, 0.0, 0.8))
    factors = np.sort(sizes.sample(101, np.random.default_rng(0)))
    assert [np.count_nonzero((a < factors) & (factors < b)) for a, b in pairwise(SIEVE.edges)] == [20, 0, 81]
    assert np.diff(factors[20:]) == pytest.approx(1.0 / 80.8)
    assert replace(sizes, fractions=(0.0, 1.0, 0.0)).smallest == 0.8


@pytest.mark.parametrize("count", [1, 7, 100])
def test_shares_by_mass_are_exact_to_one_sphere(count):
    listed = Sizes("listed", (1.0, 0.5), (0.5, 0.5), by="mass")
    factors = listed.sample(count, np.random.default_rng(0))
    assert abs(np.count_nonzero(factors == 0.5) - count * 8 / 9) <= 1.0  # 8 small ones weigh as much as a large one
    off = abs((factors[factors == 1.0] ** 3).sum() - 0.5 * (factors**3).sum())
    assert off <= 1.0


def test_uniform_and_lognormal_sizes_by_mass():
    rng = np.random.default_rng(0)
    uniform = Sizes("uniform", spread=0.5, by="mass").sample(20_000, rng)
    thirds = [mass_between(uniform, low, low + 0.25) for low in (0.5, 0.75, 1.0, 1.25)]
    assert thirds == pytest.approx([0.25] * 4, abs=1e-3)
    lognormal = Sizes("lognormal", spread=0.3, by="mass")
    factors = lognormal.sample(50_000, rng)
    logs, mass = np.log(factors) / 0.3, factors**3 / (factors**3).sum()
    assert np.abs(logs).max() < 2.0
    assert (mass * logs).sum() == pytest.approx(0.0, abs=2e-3)  # the median by mass is 1
    assert math.sqrt((mass * logs**2).sum()) == pytest.approx(0.8796, abs=2e-3)
    assert factors.min() >= lognormal.smallest
    assert factors.max() <= lognormal.largest


def test_sizes_by_mass_are_a_config(tmp_path):
    sizes = {"kind": "histogram", "by": "mass", "edges": [0.5, 1.0, 2.0], "fractions": [0.25, 0.75]}
    scene = shipped_scene("packing", {f"filling.sizes.{name}": value for name, value in sizes.items()})
    assert scene.filling.sizes == Sizes("histogram", fractions=(0.25, 0.75), edges=(0.5, 1.0, 2.0), by="mass")
    assert scene.needs.polydispersity
    assert from_document(to_document(scene)) == scene
    spec = own_case(replace(scene, filling=replace(scene.filling, count=20)), DemConfig(), DatasetConfig())
    bed = spec.scene.fresh_filling(0)
    assert bed.radius.max() <= scene.filling.largest_radius == 0.05


# ---- radii ---------------------------------------------------------------------------------------------------


def test_placed_spheres_have_the_radii_that_are_listed():
    scene = shipped_scene("collision", {"filling.radii": [0.025, 0.05]})
    state = scene.fresh_filling(0)
    assert state.radius.tolist() == [0.025, 0.05]
    assert (scene.filling.smallest_radius, scene.filling.largest_radius) == (0.025, 0.05)
    assert scene.needs.polydispersity
    assert from_document(to_document(scene)) == scene
    # A central impact on one eight times as heavy: momentum is that of these masses.
    apart = {"filling.positions": [[-0.1, 0, 0], [0.1, 0, 0]], "filling.spins": []}
    scene = shipped_scene("collision", apart | {"filling.radii": [0.025, 0.05]})
    final = simulate(scene, scene.fresh_filling(0), scene.end_time).final
    light, heavy = final.velocity[:, 0]
    assert light + 8.0 * heavy == pytest.approx(1.0 - 8.0, abs=1e-9)
    assert heavy - light == pytest.approx(0.5 * 2.0, abs=1e-2)
    # The engine's step is that of the smallest.
    small = shipped_scene("collision", apart | {"filling.diameter": 0.05})
    assert simulate(scene, scene.fresh_filling(0), 0.01).time_step == pytest.approx(
        simulate(small, small.fresh_filling(0), 0.01).time_step
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"filling.radii": [0.02]}, r"radii has 1 entries for 2 scene.filling.positions; give one for each"),
        ({"filling.radii": [0.02, 0.03], "filling.positions": [], "filling.velocities": [], "filling.spins": []},
         "radii has 2 entries for 0 scene.filling.positions"),
        ({"filling.radii": [0.02, 0.03], "filling.sizes.kind": "uniform", "filling.sizes.spread": 0.1},
         "sizes.kind=uniform and scene.filling.radii both say how large"),
    ],
)  # fmt: skip
def test_radii_that_cannot_be_are_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        shipped_scene("collision", changes)
    with pytest.raises(SceneError, match=r"scene.filling.radii\[0\]=-0.1 is impossible; choose a value > 0 m"):
        Filling(1, 0.05, positions=((0, 0, 0),), radii=(-0.1,))


def test_shares_that_do_not_divide_are_given_to_the_largest_remainders():
    assert apportioned(10, (1 / 3, 1 / 3, 1 / 3)).tolist() == [4, 3, 3]
    assert apportioned(0, (0.5, 0.5)).tolist() == [0, 0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"kind": "normal"}, "choose one or listed"),
        ({"kind": "listed"}, "give values > 0"),
        ({"kind": "listed", "factors": (1.0, 2.0), "fractions": (0.5, 0.4)}, "sum to 1"),
        ({"kind": "listed", "factors": (1.0, -1.0), "fractions": (0.5, 0.5)}, "choose a value > 0"),
        ({"kind": "uniform", "spread": 1.0}, r"in \[0, 1\)"),
        ({"kind": "uniform"}, r"in \(0, 1\)"),
        ({"spread": 0.1}, "kind=uniform or lognormal"),
        ({"factors": (1.0,)}, "kind=listed"),
        ({"edges": (1.0, 2.0)}, "kind=histogram"),
        ({"by": "volume"}, "by=volume is impossible; choose number or mass"),
        ({"kind": "histogram"}, "give two or more values > 0 that rise"),
        ({"kind": "histogram", "edges": (0.0, 1.0), "fractions": (1.0,)}, r"edges\[0\]=0 is impossible"),
        ({"kind": "histogram", "edges": (2.0, 1.0), "fractions": (1.0,)}, "values > 0 that rise"),
        ({"kind": "histogram", "edges": (1.0, 2.0), "fractions": (0.5, 0.5)}, "give 1 shares"),
    ],
)
def test_a_distribution_that_cannot_be_is_refused(arguments, words):
    with pytest.raises(SceneError, match=words):
        Sizes(**arguments)


def test_a_polydisperse_lattice_has_room_for_the_largest_and_the_step_is_that_of_the_smallest():
    scene = shipped_scene("packing_polydisperse", {"filling.count": 100})
    state = scene.fresh_filling(0)
    assert state.radius.min() >= scene.filling.smallest_radius
    assert state.radius.max() <= scene.filling.largest_radius
    gaps = np.linalg.norm(state.position[:, None] - state.position, axis=2) - state.radius[:, None] - state.radius
    assert gaps[~np.eye(100, dtype=bool)].min() > 0
    monodisperse = replace(scene, filling=replace(scene.filling, sizes=Sizes(), diameter=2 * state.radius.min()))
    assert (
        simulate(scene, state, 0.01).time_step == simulate(monodisperse, monodisperse.fresh_filling(0), 0.01).time_step
    )
