"""Who is compared on a scene: the DEM over a ladder of steps, softened and in float32, surrogates, baselines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from gran_bench.baselines import neighbouring_speeds
from gran_bench.benchmark.jobs import BASELINES, with_modulus
from gran_bench.benchmark.method import Method
from gran_bench.config import BenchmarkConfig, DemConfig, SceneConfig
from gran_bench.config.reading import read_config
from gran_bench.dataset import CaseSpec, half_step, read_attributes, replicas, to_document
from gran_bench.dem.simulate import choose_time_step, dividing_step
from gran_bench.dem.time_step import ERROR_FRACTION, contact_times
from gran_bench.scene import Scene, build_scene
from gran_bench.surrogate.checkpoint import ModelCard, file_digest, load_card

AUTOMATIC = "DEM"  # first word of the method that all times are held against: this engine, this step


@dataclass(frozen=True)
class Contest:
    """A scene, the state that all start from, and everyone who answers for it.

    Attributes:
        config: of the command.
        models: model files by the name that they are shown under.
    """

    config: BenchmarkConfig
    models: dict[str, Path]

    @property
    def scene(self) -> Scene:
        """At the held-out speed, or with the motion that it keeps."""
        scene = build_scene(self.config.scene)
        return scene.at_speed(self.rpm) if scene.takes_speeds else scene

    @property
    def rpm(self) -> float:
        """The held-out speed; of no meaning to a scene that keeps its own motion."""
        return float(self.config.dataset.holdout_speeds_rpm[0])

    @property
    def case(self) -> CaseSpec:
        """The run of the DEM whose settled state all methods start from: a packing that no training saw."""
        return CaseSpec(self.scene, self.config.dem, self.config.dataset.unseen_packing_seed)

    @property
    def replicas(self) -> list[CaseSpec]:
        """What errors are measured from: nudged runs of the DEM at half its automatic step."""
        return replicas(half_step(self.case), self.config.dataset.replicas)

    @property
    def neighbours(self) -> dict[float, CaseSpec]:
        """The training speeds below and above, rpm, from the packing of training; none where a side lacks one."""
        found = neighbouring_speeds(self.rpm, self.config.dataset.training_speeds_rpm)
        if found is None or not build_scene(self.config.scene).takes_speeds:
            return {}
        return {rpm: self._training_case(rpm) for rpm in found}

    @property
    def cases(self) -> list[CaseSpec]:
        """Every run of the DEM that the comparison needs before anything is timed."""
        return [*self.replicas, *self.neighbours.values(), *self._count_cases.values()]

    @property
    def automatic(self) -> str:
        """Name of the DEM at its automatic step."""
        return next(self._dem_ladder([1.0])).name

    @property
    def methods(self) -> list[Method]:
        """Everyone who is compared, those who do not fit included."""
        profile = self.config.profile
        found = [*self._dem_ladder(profile.step_multiples)]
        found += self._dem_ladder(profile.single_multiples, precision="float32")
        for modulus in profile.soft_moduli:
            if modulus < self.scene.material.youngs_modulus:
                found += self._dem_ladder(profile.soft_multiples, modulus)
        if profile.numpy_frames:
            found.append(self._numpy(profile.numpy_frames))
        found += [self._surrogate(name, path, self.scene, self.case) for name, path in self.models.items()]
        found += [*self._baselines()]
        return list({method.name: method for method in found}.values())  # two multiples may round to one step

    @property
    def stiffness_methods(self) -> dict[str, list[tuple[float, Method]]]:
        """What is timed against stiffness: by label, the modulus (Pa) and the method there."""
        found: dict[str, list[tuple[float, Method]]] = {"automatic": [], "largest": []}
        if not build_scene(self.config.scene).takes_speeds:
            return {}
        for modulus in sorted(self.config.profile.stiffness):
            scene = with_modulus(self.scene, modulus)
            stages = [*_decades(self.scene.material.youngs_modulus, modulus)]
            for label, step in (("automatic", None), ("largest", largest_allowed_step(scene))):
                dem = replace(self.config.dem, time_step=step, threads=1)
                job = self._dem_job(scene, dem, self.case, stages)
                found[label].append((modulus, self._short(f"E = {modulus:g} Pa, {label} step", "dem", job)))
        for name, path in self.models.items():
            method = self._surrogate(name, path, self.scene, self.case)
            if not method.unfit_because:
                found[name] = [(self.scene.material.youngs_modulus, self._short(name, "surrogate", method.job))]
        return found if found["automatic"] else {}

    @property
    def count_methods(self) -> dict[str, list[tuple[int, Method]]]:
        """What is timed against the number of spheres: by label, the number and the method there."""
        found: dict[str, list[tuple[int, Method]]] = {"DEM": []} if self._count_cases else {}
        for count, case in self._count_cases.items():
            dem = replace(self.config.dem, threads=1)
            job = self._dem_job(case.scene, dem, case, [])
            found["DEM"].append((count, self._short(f"DEM, {count} spheres", "dem", job)))
            for name, path in self.models.items():
                method = self._surrogate(name, path, case.scene, case)
                if not method.unfit_because:
                    short = self._short(f"{name}, {count} spheres", "surrogate", method.job)
                    found.setdefault(name, []).append((count, short))
        return found

    # ---- the parts -------------------------------------------------------------------------------------------

    def _dem_ladder(
        self, multiples: list[float], modulus: float | None = None, precision: str = "float64"
    ) -> Iterator[Method]:
        """The fast engine at multiples of its automatic step, also beyond what is safe."""
        scene = self.scene if modulus is None else with_modulus(self.scene, modulus)
        automatic, _ = choose_time_step(scene)
        for multiple in multiples:
            step = dividing_step(scene.frame_interval, multiple * automatic)
            dem = replace(
                self.config.dem, time_step=step, threads=1, precision=precision, allow_unsafe_step=True, engine="numba"
            )
            words = [f"{AUTOMATIC} {1e3 * step:.3g} ms"]
            words += [f"E = {modulus:.0e} Pa".replace("e+0", "e")] if modulus is not None else []
            words += ["float32"] if precision == "float32" else []
            yield self._whole(", ".join(words), "dem", self._dem_job(scene, dem, self.case, []))

    def _numpy(self, frames: int) -> Method:
        step, _ = choose_time_step(self.scene)
        dem = DemConfig(engine="numpy", time_step=step)
        job, name = self._dem_job(self.scene, dem, self.case, []), f"{AUTOMATIC} {1e3 * step:.3g} ms, numpy engine"
        return Method(name, "dem", job, frames * self.scene.frame_interval, judged=False)

    def _dem_job(self, scene: Scene, dem: DemConfig, case: CaseSpec, stages: list[float]) -> dict[str, Any]:
        bed = str(case.settled_path(self.config.dataset.root))
        return {"does": "dem", "scene": to_document(scene), "dem": asdict(dem), "bed": bed, "stages": stages}

    def _surrogate(self, name: str, path: Path, scene: Scene, case: CaseSpec) -> Method:
        card, _ = load_card(path)
        origin = card.origin
        bed = str(case.settled_path(self.config.dataset.root))
        job = {"does": "surrogate", "scene": to_document(scene), "bed": bed, "model": str(path)}
        return Method(
            name,
            "surrogate",
            job | {"weights": file_digest(path)},
            scene.end_time - scene.start_time,
            data_seconds=float(origin.get("data_seconds", 0.0)),
            training_seconds=float(origin.get("seconds", 0.0)),
            unfit_because=why_unfit(card, scene, case.packing_seed),
        )

    def _baselines(self) -> Iterator[Method]:
        bed = str(self.case.settled_path(self.config.dataset.root))
        for name in BASELINES:
            yield self._whole(name, "baseline", {"does": name, "scene": to_document(self.scene), "bed": bed})
        cases = self.neighbours
        if not cases:
            reason = "there are no runs of this scene at a lower and at a higher speed"
            yield Method("interpolation", "baseline", {}, 0.0, unfit_because=reason)
            return
        root = self.config.dataset.root
        paths = {f"{rpm:g}": str(case.path(root)) for rpm, case in cases.items()}
        spent = [read_attributes(path) for path in map(Path, paths.values()) if path.exists()]
        seconds = sum(float(facts["wall_seconds"]) for facts in spent)
        seconds += max((float(facts["settling_wall_seconds"]) for facts in spent), default=0.0)
        low, high = cases
        yield replace(
            self._whole(
                f"interpolation, {low:g} and {high:g} rpm",
                "baseline",
                {"does": "interpolation", "cases": paths, "rpm": self.rpm},
            ),
            data_seconds=seconds,
        )

    def _whole(self, name: str, kind: str, job: dict[str, Any]) -> Method:
        return Method(name, kind, job, self.scene.end_time - self.scene.start_time)

    def _short(self, name: str, kind: str, job: dict[str, Any]) -> Method:
        return Method(name, kind, job, self.config.profile.study_frames * self.scene.frame_interval, judged=False)

    def _training_case(self, rpm: float) -> CaseSpec:
        return CaseSpec(self.scene.at_speed(rpm), self.config.dem, self.config.dataset.packing_seed)

    @property
    def _count_cases(self) -> dict[int, CaseSpec]:
        """Drums of other lengths, filled as high, that run only as long as they are timed.

        A short one gets a sphere's diameter more: its first lattice would not fit between the caps.
        """
        config = self.config.scene
        if not build_scene(config).takes_speeds:
            return {}
        found = {}
        for count in sorted(self.config.profile.counts):
            length = config.container.length * count / config.filling.count
            if count < config.filling.count:
                length += config.filling.diameter
            scene = build_scene(
                replace(
                    config,
                    name=f"{config.name}_{count}",
                    container=replace(config.container, length=length),
                    filling=replace(config.filling, count=count),
                    end_time=config.start_time + self.config.profile.study_frames * config.frame_interval,
                )
            )
            found[count] = CaseSpec(scene.at_speed(self.rpm), self.config.dem, self.config.dataset.unseen_packing_seed)
        return found


def why_unfit(card: ModelCard, scene: Scene, packing_seed: int) -> str:
    """Why a trained model cannot answer for a scene, or may not; empty where it can.

    Args:
        card: of the model.
        scene: with its motion.
        packing_seed: of the bed that it would start from.
    """
    home = build_scene(read_config(SceneConfig, card.scene))
    if scene.needs.polydispersity:
        return "it knows spheres of one size alone"
    if len(scene.materials) > 1:
        return "it knows one material alone"
    same = {
        "diameter": (2.0 * scene.filling.largest_radius, 2.0 * home.filling.largest_radius),
        "frame interval": (scene.frame_interval, home.frame_interval),
        "gravity": (scene.gravity, home.gravity),
        "material": (scene.material, home.material),
        "wall material": (scene.wall_material, home.wall_material),
    }
    for what, (here, there) in same.items():
        if here != there:
            return f"it was trained with another {what}"
    # The other sense of rotation is the mirror image.
    speeds = set(map(abs, scene.rotation.speeds_rpm))
    if scene.takes_speeds and speeds & set(map(abs, card.origin.get("training_speeds_rpm", ()))):
        return f"it was trained at {max(speeds):g} rpm"
    if scene.takes_speeds and card.origin.get("packing_seed") == packing_seed:
        return f"it was trained on packing {packing_seed}"
    return ""


def largest_allowed_step(scene: Scene) -> float:
    """The largest step that the DEM takes without being told to: just under 0.2 of the contact time, s."""
    return dividing_step(scene.frame_interval, ERROR_FRACTION * contact_times(scene)[0] * (1.0 - 1e-6))


def _decades(low: float, high: float) -> Iterator[float]:
    """Moduli between the bed's and the wanted one, a factor of ten apart, the wanted one included; none if softer."""
    modulus = 10.0 * low
    while modulus < high:
        yield modulus
        modulus *= 10.0
    if high > low:
        yield high
