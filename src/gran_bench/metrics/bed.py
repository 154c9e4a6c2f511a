"""Figures of a whole bed: kinetic energy, the height of its centre of mass, overlaps with pairs and walls, mixing."""

import math

import numpy as np
from scipy.special import entr

from gran_bench.config.registry import register_metric
from gran_bench.config.rules import check_arguments
from gran_bench.metrics.angle_of_repose import cross_section_axes
from gran_bench.metrics.measured import Series
from gran_bench.metrics.speeds import velocities
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.scene import Plane, Scene, Wall
from gran_bench.state import FloatArray, Trajectory

CELL = 2.0  # diameters, edge of a square cell of the cross-section, for mixing
OVERLAPS = {
    "overlap_mean": "overlap of pairs, mean",
    "overlap_max": "overlap of pairs, largest",
    "wall_overlap_mean": "overlap with walls, mean",
    "wall_overlap_max": "overlap with walls, largest",
}


def sphere_masses(radius: FloatArray, density: float) -> FloatArray:
    """m = 4/3 π ρ r³, ``(N,)`` kg, of ``(N,)`` radii in m and a density in kg/m³."""
    return 4.0 / 3.0 * math.pi * density * radius.astype(np.float64) ** 3


@register_metric("translational energy", "J")
def translational_energy(trajectory: Trajectory, scene: Scene) -> Series:
    """Σ ½ m v² of each state, J."""
    mass = sphere_masses(trajectory.radius, scene.material.density)
    value = _half_sum(velocities(trajectory, trajectory.velocity_kind), mass)
    return Series(trajectory.time, value, "J", invalid_because="velocity is not finite")


@register_metric("rotational energy", "J")
def rotational_energy(trajectory: Trajectory, scene: Scene) -> Series:
    """Σ ½ (2/5 m r²) ω² of each state, J; undefined where a model has no spin."""
    if trajectory.angular_velocity is None:
        nothing = np.full(trajectory.frame_count, np.nan)
        return Series(trajectory.time, nothing, "J", undefined_because="the model has no spin")
    mass = sphere_masses(trajectory.radius, scene.material.density)
    inertia = 0.4 * mass * trajectory.radius.astype(np.float64) ** 2
    value = _half_sum(trajectory.angular_velocity, inertia)
    return Series(trajectory.time, value, "J", invalid_because="spin is not finite")


@register_metric("height of the centre of mass", "m")
def center_height(trajectory: Trajectory, scene: Scene) -> Series:
    """Σ m z / Σ m of each state, m."""
    mass = sphere_masses(trajectory.radius, scene.material.density)
    with np.errstate(invalid="ignore", over="ignore"):
        height = trajectory.position[..., 2].astype(np.float64) @ (mass / mass.sum())
    return Series(trajectory.time, np.where(np.isfinite(height), height, np.nan), "m", invalid_because="not finite")


def _half_sum(rate: FloatArray, weight: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", over="ignore"):
        value = 0.5 * np.einsum("fnk,fnk,n->f", rate, rate, weight, dtype=np.float64)
    return np.where(np.isfinite(value), value, np.nan)


def pair_overlaps(position: FloatArray, radius: FloatArray, period: float = 0.0) -> FloatArray:
    """Overlap r_i + r_j − ‖x_j − x_i‖ > 0 of every touching pair of N spheres, ``(M,)`` m; ``period`` is that of y."""
    pairs = tree_pairs(position, 2.0 * float(radius.max()), period)
    offset = nearest_image(position[pairs[:, 1]] - position[pairs[:, 0]], period)
    overlap = radius[pairs].sum(axis=1) - np.sqrt((offset**2).sum(axis=1))
    return overlap[overlap > 0]


def wall_overlap(position: FloatArray, radius: FloatArray, wall: Wall) -> FloatArray:
    """How far spheres at ``(..., N, 3)`` m reach into a plane or a cylinder, ``(..., N)`` m; a gap is negative."""
    offset = position - np.asarray(wall.point)
    if isinstance(wall, Plane):
        return radius - offset @ np.asarray(wall.normal)
    axis = np.asarray(wall.axis)
    across = offset - (offset @ axis)[..., None] * axis
    return radius - (wall.radius - np.sqrt((across**2).sum(axis=-1)))


def overlap_series(trajectory: Trajectory, scene: Scene) -> dict[str, Series]:
    """Mean over the touching contacts, and largest, of pairs and walls, in every state, m; 0 without a contact.

    The engine's own figures are taken where the trajectory carries them, because they were computed in float64;
    otherwise they come from the positions and the walls that contain.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    if all(name in trajectory.diagnostics for name in OVERLAPS):
        values = [np.asarray(trajectory.diagnostics[name], np.float64) for name in OVERLAPS]
    else:
        radius = trajectory.radius.astype(np.float64)
        values = np.array([_figures(frame.astype(np.float64), radius, scene) for frame in trajectory.position]).T
    return {
        name: Series(trajectory.time, value, "m", invalid_because="position is not finite")
        for name, value in zip(OVERLAPS, values, strict=True)
    }


def _register(name: str, label: str) -> None:
    def measure(trajectory: Trajectory, scene: Scene) -> Series:
        return overlap_series(trajectory, scene)[name]

    measure.__name__ = name
    register_metric(label, "m")(measure)


for _name, _label in OVERLAPS.items():
    _register(_name, _label)


def _figures(position: FloatArray, radius: FloatArray, scene: Scene) -> list[float]:
    if not np.isfinite(position).all():
        return [np.nan] * 4
    walls = [wall_overlap(position, radius, wall) for wall in scene.walls if wall.contains]
    touching = np.concatenate([overlap[overlap > 0] for overlap in walls]) if walls else np.zeros(0)
    found = (pair_overlaps(position, radius, scene.period), touching)
    return [figure for overlap in found for figure in ((overlap.mean(), overlap.max()) if len(overlap) else (0.0, 0.0))]


@register_metric("mixing entropy", "-")
def mixing(trajectory: Trajectory, scene: Scene) -> Series:
    """Entropy of mixing of every state, 0 (apart) to 1 (mixed), −.

    S = −Σ_c n_c (p_c ln p_c + q_c ln q_c) / (N ln 2), p_c and q_c the shares of the two colours among the n_c
    spheres of cell c (Arntz et al., AIChE J. 54, 2008). A sphere's colour is the half of the first state's bed, left
    or right of its median along the climbing direction, that it lay in. Cells are 2 d squares of the cross-section
    over the full length, which hold enough spheres to leave little bias from small numbers.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    value = np.full(trajectory.frame_count, np.nan)
    if not scene.needs.gravity or not len(trajectory.radius):
        return Series(trajectory.time, value, "-", undefined_because="the scene has no bed")
    across = trajectory.position.astype(np.float64) @ np.stack(cross_section_axes(scene), axis=1)
    if not np.isfinite(across[0]).all():
        return Series(trajectory.time, value, "-", undefined_because="the first state is not finite")
    coloured = across[0, :, 0] > np.median(across[0, :, 0])
    edge = CELL * scene.filling.diameter
    for frame, centers in enumerate(across):
        if not np.isfinite(centers).all():
            continue
        # Ranks instead of numbers of cells: these have no largest, however far a sphere flies.
        column, row = (np.unique(line, return_inverse=True)[1] for line in np.floor(centers / edge).T)
        _, cell = np.unique(column * len(centers) + row, return_inverse=True)
        count = np.bincount(cell)
        share = np.bincount(cell, coloured) / count
        value[frame] = (count * (entr(share) + entr(1.0 - share))).sum() / (count.sum() * np.log(2.0))
    return Series(trajectory.time, value, "-", invalid_because="position is not finite")
