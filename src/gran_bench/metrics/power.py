"""Torque and power that drive a drum, from the motion of the spheres alone, so that a surrogate has them too."""

import math

import numpy as np

from gran_bench.config.registry import register_metric
from gran_bench.config.rules import check_arguments
from gran_bench.metrics.bed import sphere_masses
from gran_bench.metrics.measured import Series
from gran_bench.metrics.speeds import velocities
from gran_bench.scene import Scene
from gran_bench.state import Trajectory


@register_metric("torque that drives the drum", "N m")
def driving_torque(trajectory: Trajectory, scene: Scene) -> Series:
    """What the walls exert on the spheres about the drum's axis, N m, as the mean over the frame that ends at a state.

        T = (L_k − L_{k−1}) / Δt − ½ (G_k + G_{k−1}),    L = Σ m (x × v)·e + Σ I ω·e,    G = Σ m (x × g)·e

    with e along the axis in the sense of the rotation, so that a positive torque drives the drum. The first state has
    no frame before it. A model without spin counts none. The DEM's own sum over its contacts, with ``dem.power=true``,
    differs by how the torque of gravity changes within a frame.
    """
    check_arguments(trajectory=(trajectory, Trajectory), scene=(scene, Scene))
    torque = np.full(trajectory.frame_count, np.nan)
    if scene.drum_radius is None:
        return Series(trajectory.time, torque, "N m", undefined_because="the scene has no drum")
    mass = sphere_masses(trajectory.radius, scene.material.density)
    axis, point, gravity = (np.asarray(v) for v in (scene.rotation.axis, scene.rotation.point, scene.gravity))
    axis = _sense(scene) * axis
    velocity = velocities(trajectory, trajectory.velocity_kind, scene.period)
    momentum, weight = np.empty_like(torque), np.empty_like(torque)
    with np.errstate(invalid="ignore", over="ignore"):
        for k, position in enumerate(trajectory.position):
            arm = position.astype(np.float64) - point
            momentum[k] = mass @ (np.cross(arm, velocity[k]) @ axis)
            weight[k] = np.cross(mass @ arm, gravity) @ axis
            if trajectory.angular_velocity is not None:
                inertia = 0.4 * mass * trajectory.radius.astype(np.float64) ** 2
                momentum[k] += inertia @ (trajectory.angular_velocity[k].astype(np.float64) @ axis)
        torque[1:] = np.diff(momentum) / np.diff(trajectory.time) - 0.5 * (weight[1:] + weight[:-1])
    torque[~np.isfinite(torque)] = np.nan
    return Series(trajectory.time, torque, "N m", invalid_because="it needs two states of finite motion")


@register_metric("power that drives the drum", "W")
def driving_power(trajectory: Trajectory, scene: Scene) -> Series:
    """P = ω T of :func:`driving_torque`, with ω in the middle of the frame, W."""
    torque = driving_torque(trajectory, scene)
    middle = trajectory.time - 0.5 * scene.frame_interval
    value = torque.value * _sense(scene) * scene.rotation.angular_speed(middle)
    return Series(torque.time, value, "W", torque.undefined_because, torque.invalid_because)


def _sense(scene: Scene) -> float:
    """1, or −1 in a drum whose first speed is negative."""
    return math.copysign(1.0, next((speed for speed in scene.rotation.speeds_rpm if speed), 1.0))
