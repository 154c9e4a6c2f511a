"""The mass flow of a conical hopper against Beverloo's law: four orifices, some two minutes of one core.

    python benchmarks/hopper_discharge.py [--output results/verification] [--seed 0]

With --output the part hopper_discharge of the page there is renewed, and a figure written beside it. The law is

    W = C ρ_b √g (D − k d)^{5/2}

with ρ_b the bulk density, D the diameter of the orifice and d that of the spheres: what leaves falls freely from about
one orifice above it, so that the fill height does not matter. k ≈ 1.4 for spheres: no centre passes within some
half a diameter of the rim. Source: Beverloo, Leniger & van de Velde (1961), Chem. Eng. Sci. 15, 260; k and C of
spheres: Nedderman (1992), Statics and Kinematics of Granular Materials, §10.2. The flow out of a cone is faster than
out of a flat bottom, by a factor that its angle decides; the exponent is the same.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from dem_page import PAGE, made_by_this

from gran_bench.config import FillingConfig, HopperConfig, MaterialConfig, SceneConfig
from gran_bench.dem.contact import sphere_mass
from gran_bench.dem.simulate import settle, simulate
from gran_bench.files import write_part
from gran_bench.plots.verification import HopperDischarge, draw_discharge
from gran_bench.provenance import stamp
from gran_bench.scene import Scene, build_scene
from gran_bench.state import FloatArray

NAME = "hopper_discharge"
EXPECTED, TOLERANCE = 2.5, 0.15  # of the exponent
RIM = 1.4  # k, sphere diameters
ORIFICES = (6.0, 7.2, 8.7, 10.4)  # D/d
TUBE = 26.0  # sphere diameters: 2.5 of the widest orifice
STARTUP = 0.4  # s from the opening until the flow is steady
BLOCKS = 8  # of the steady part, whose scatter gives the flow's error


def hopper(orifice: float, diameter: float = 0.02, count: int = 9000, tube: float = TUBE) -> Scene:
    """A hopper of 45° with N = ``count`` spheres of E = 1e7 Pa, e = 0.5, μ = 0.5; orifice and tube in d, d in m."""
    container = HopperConfig(
        diameter=tube * diameter, height=40.0 * diameter, half_angle_deg=45.0,
        orifice=orifice * diameter, outlet_depth=2.0 * diameter,
    )  # fmt: skip
    filling = FillingConfig(count=count, diameter=diameter, settled_speed=5e-3)
    return build_scene(
        SceneConfig("hopper", container, filling, MaterialConfig(friction=0.5), start_time=1.0, end_time=5.0)
    )


def discharge(orifices: Sequence[float] = ORIFICES, seed: int = 0, **hopper_options: float) -> HopperDischarge:
    """Empty a hopper through orifices of several sizes and fit the exponent of Beverloo's law.

    Args:
        orifices: D/d, two or more.
        seed: of the fillings.
        hopper_options: of :func:`hopper`.
    """
    scenes = [hopper(size, **hopper_options) for size in orifices]
    flow, error, density = np.transpose([steady_flow(scene, seed) for scene in scenes])
    diameter, gravity = scenes[0].filling.diameter, scenes[0].gravity_strength
    orifice, bulk = diameter * np.array(orifices), float(np.mean(density))
    opening = orifice - RIM * diameter
    factor = float(np.exp(np.mean(np.log(flow / (bulk * math.sqrt(gravity) * opening**2.5)))))
    return HopperDischarge(orifice, flow, error, *power_law(opening, flow, error), factor, diameter, bulk, RIM)


def steady_flow(scene: Scene, seed: int = 0) -> tuple[float, float, float]:
    """Mass flow out of a hopper while two fifths of its spheres leave, 2 s at most, and the density of its bed.

    Returns:
        W in kg/s, its standard error, and ρ_b in kg/m³ of the settled bed.
    """
    bed = settle(scene, seed)
    mass = sphere_mass(scene.material.density, scene.filling.radius)
    bulk = bulk_density(scene, bed.position)
    wide = scene.outlet.radius  # of the orifice, its diameter
    expected = 0.7 * bulk * math.sqrt(scene.gravity_strength) * (wide - RIM * scene.filling.diameter) ** 2.5
    duration = STARTUP + min(2.0, 0.4 * len(bed.position) * mass / expected)
    end = scene.start_time + round(duration / scene.frame_interval) * scene.frame_interval
    trajectory = simulate(scene, bed, end).trajectory
    steady = trajectory.time >= scene.start_time + STARTUP - 1e-9
    time, left = trajectory.time[steady], mass * trajectory.diagnostics["discharged"][steady]
    edges = np.linspace(0, len(time) - 1, BLOCKS + 1).round().astype(int)
    blocks = np.diff(left[edges]) / np.diff(time[edges])
    return float(np.polyfit(time, left, 1)[0]), float(blocks.std(ddof=1) / math.sqrt(BLOCKS)), bulk


def bulk_density(scene: Scene, position: FloatArray) -> float:
    """ρ_b of the settled bed inside the tube, between the cone and three diameters below its surface, kg/m³.

    Each sphere counts with the share of it that lies between the two heights.
    """
    radius, low = scene.filling.radius, scene.room.lower[2]
    high = np.quantile(position[:, 2], 0.98) - 6.0 * radius
    bottom, top = (np.clip(edge - position[:, 2], -radius, radius) for edge in (low, high))

    def below(height: FloatArray) -> FloatArray:
        return math.pi * (radius**2 * height - height**3 / 3.0 + 2.0 * radius**3 / 3.0)

    volume = math.pi * scene.room.radius**2 * (high - low)
    return scene.material.density * float((below(top) - below(bottom)).sum()) / volume


def power_law(opening: FloatArray, flow: FloatArray, error: FloatArray) -> tuple[float, float]:
    """Exponent n of W ∝ (D − k d)^n by least squares of the logarithms, and its standard error.

    The error is the larger of two: what the scatter about the line says, and what the flows' own errors make of it.
    """
    x, y = np.log(opening), np.log(flow)
    centred = x - x.mean()
    weight = centred / (centred @ centred)
    exponent = float(weight @ y)
    residual = y - y.mean() - exponent * centred
    scatter = math.sqrt(residual @ residual / max(len(x) - 2, 1) / (centred @ centred)) if len(x) > 2 else 0.0
    return exponent, max(scatter, float(np.linalg.norm(weight * error / flow)))


def table(result: HopperDischarge) -> list[str]:
    """A row an orifice, as Markdown."""
    lines = ["| D/d | D − k d, m | W, kg/s | two standard errors, kg/s |", "|---:|---:|---:|---:|"]
    rows = zip(result.orifice / result.diameter, result.opening, result.flow, result.flow_error, strict=True)
    return lines + [f"| {d:.1f} | {opening:.4f} | {flow:.3f} | {2 * error:.3f} |" for d, opening, flow, error in rows]


def part(result: HopperDischarge) -> str:
    """What came out, and whether Beverloo's law holds."""
    met = "met" if abs(result.exponent - EXPECTED) <= TOLERANCE else "FAILED"
    lines = [
        f"**Exponent {result.exponent:.3f} ± {result.exponent_error:.3f}** (standard error); expected {EXPECTED:g} ± "
        f"{TOLERANCE:g}: {met}. C = {result.factor:.3f} with the exponent 5/2 and k = {result.rim:g}, bulk density of "
        f"the settled bed {result.bulk_density:.0f} kg/m³.",
        "",
        *table(result),
        "",
        f"![The flows against D − k d, both axes logarithmic; bars are two standard errors.]({NAME}.png)",
        "",
        stamp(made_by_this()),
    ]
    return "\n".join(lines)


def main(output: Path | None, seed: int) -> None:
    """Discharges the hoppers, prints what came out and writes it into the page of a folder."""
    result = discharge(seed=seed)
    text = part(result)
    print(text)
    if output is not None:
        draw_discharge(output / f"{NAME}.png", result)
        write_part(output / PAGE, NAME, text, heading="Discharge of a conical hopper")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, help="folder whose page gets the table; figure beside it")
    parser.add_argument("--seed", type=int, default=0, help="of the fillings")
    given = parser.parse_args()
    main(given.output, given.seed)
