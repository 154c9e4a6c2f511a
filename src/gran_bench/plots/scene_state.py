"""One state of any scene, cut open: the spheres of its vertical middle plane, coloured by speed, and its walls."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from gran_bench.dem.outlet import taking_part
from gran_bench.dem.walls import ABSENT, KIND, PLANE, wall_contact, wall_poses
from gran_bench.plots.style import BAND, SPEED_MAP, drawing
from gran_bench.scene import Scene
from gran_bench.state import FloatArray, ParticleState

LATTICE = 900  # points of the plane along its longer side, at which the distance to a wall is looked up


def scene_state(path: Path | str, scene: Scene, state: ParticleState, title: str = "") -> None:
    """Draw the spheres that the plane y = 0 cuts as the circles that it cuts out, and the walls as lines.

    Spheres that have left through the outlet are grey. Where y = 0 cuts no sphere, the nearest centre's y is taken.
    """
    low, high = _view(scene, state)
    y = state.position[:, 1]
    depth = 0.0 if not len(y) or (np.abs(y) < state.radius).any() else float(y[np.argmin(np.abs(y))])
    width, height = 6.0 * (high - low) / (high - low).max()
    with drawing(path, max(4.2, width + 1.3), max(2.4, height + 0.9)) as figure:
        axes = figure.add_subplot()
        axes.grid(False)
        _draw_spheres(axes, scene, state, depth)
        _draw_walls(axes, scene, state.time, depth, low, high)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x, m", ylabel="z, m")
        axes.set_title(title or f"{scene.name}, {state.time:.2f} s\ncut at y = {depth:.3g} m")


def _view(scene: Scene, state: ParticleState) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner (x, z) of what is shown, m: the container, or else the spheres."""
    if scene.drum_radius is not None:
        corners = scene.drum_radius * np.array([[-1.0, -1.0], [1.0, 1.0]])
    elif scene.room is not None:
        corners = np.array([scene.room.lower, scene.room.upper])[:, ::2]
        floors = [wall.point[2] for wall in scene.walls]
        if scene.outlet is not None:
            floors.append(scene.outlet.point[2] - 2.0 * scene.filling.diameter)
        corners[0, 1] = min([corners[0, 1], *floors])
    else:
        across, reach = state.position[:, ::2], state.radius[:, None]
        corners = np.array([(across - reach).min(axis=0), (across + reach).max(axis=0)])
    margin = 0.03 * (corners[1] - corners[0]).max()
    return corners[0] - margin, corners[1] + margin


def _draw_spheres(axes: Axes, scene: Scene, state: ParticleState, depth: float) -> None:
    beside = state.position[:, 1] - depth
    size = 2.0 * np.sqrt(np.maximum(0.0, state.radius**2 - beside**2))
    inside = taking_part(scene, state.position)
    left = np.zeros(state.count, bool) if inside is None else ~inside

    def circles(which: np.ndarray, **look: Any) -> EllipseCollection:
        cut = size[which]
        place = {"offsets": state.position[which][:, ::2], "offset_transform": axes.transData}
        look |= {"edgecolor": "white", "linewidth": 0.2}
        return axes.add_collection(EllipseCollection(cut, cut, np.zeros(len(cut)), units="xy", **place, **look))

    circles((size > 0) & left, facecolor=BAND)
    moving = (size > 0) & ~left
    speed = np.linalg.norm(state.velocity, axis=1)[moving]
    spheres = circles(moving, cmap=SPEED_MAP, array=speed, clim=(0.0, max(float(speed.max(initial=0.0)), 1e-3)))
    axes.figure.colorbar(spheres, ax=axes, label="speed, m/s", shrink=0.8)


def _draw_walls(axes: Axes, scene: Scene, time: float, depth: float, low: FloatArray, high: FloatArray) -> None:
    """Each wall as the line where its distance is least; what two-sided walls and planes have in common."""
    step = (high - low).max() / LATTICE
    x, z = (np.arange(low[k], high[k] + step, step) for k in (0, 1))
    plane = np.stack(np.broadcast_arrays(x[None, :], depth, z[:, None]), axis=-1).reshape(-1, 3)
    for pose in wall_poses(scene, time, 0.0, 0)[0]:
        if pose[KIND] == ABSENT or (pose[KIND] == PLANE and abs(pose[5]) > 0.999):
            continue  # gone, or the plane of the paper itself
        distance = wall_contact(pose, plane)[0].reshape(len(z), len(x))
        near = np.abs(distance) < 0.8 * step
        axes.contourf(x, z, near.astype(float), levels=[0.5, 1.5], colors=["#333333"])
