"""Who is compared on a scene: the DEM at many steps, softened, in float32, coarse-grained; models, baselines."""

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.baselines import neighbouring_speeds
from gran_bench.benchmark.jobs import BASELINES, with_modulus
from gran_bench.config import BenchmarkConfig, DemConfig, SceneConfig
from gran_bench.config.reading import read_config
from gran_bench.config.registry import MODELS
from gran_bench.dataset import CaseSpec, half_step, read_attributes, replicas, to_document
from gran_bench.dem.time_step import choose_time_step, dividing_step, largest_allowed_step
from gran_bench.emulator.network import Emulator, emulator_of
from gran_bench.scene import Scene, SceneError, build_scene
from gran_bench.surrogate.checkpoint import ModelCard, file_digest, load_card

COARSE_PACKINGS = 3  # settled beds that the rounds of a coarse-grained DEM take turns with
Study = dict[str, list[tuple[float, "Method"]]]  # by label: an abscissa, and the method that is timed there


@dataclass(frozen=True)
class Method:
    """A method on a scene."""

    name: str  # for people, unique among those that are compared
    kind: str  # ``dem``, ``surrogate``, ``emulator`` or ``baseline``
    job: dict[str, Any]  # what a worker does, as plain data (`jobs.prepare`); empty of a method that does not fit
    seconds: float  # of the scene that one run of the job covers
    data_seconds: float = 0.0  # wall time of the data that it was made from, s
    training_seconds: float = 0.0  # wall time of its training, s
    judged: bool = True  # whether a run covers the whole scene, so that its error is known
    unfit_because: str = ""  # why it cannot answer for this scene; empty where it can
    beyond: str = ""  # in what the scene goes beyond what it learned from; empty where it does not

    @property
    def packings(self) -> int:
        """Settled beds that its rounds take turns with."""
        return len(self.job.get("beds", "1"))

    @property
    def has_frames(self) -> bool:
        """Whether a run gives frames to judge, rather than statistics that its model gives at any time."""
        return self.job["does"] not in ("emulator", "interpolation")

    def key(self, *conditions: str) -> str:
        """A readable name of its files, with a hash of job, length and whatever else decides a measurement."""

        def name_of(value: Any) -> Any:
            # Without the folders that files are in: the same data in another place are the same data.
            if isinstance(value, dict):
                return {k: Path(path).name for k, path in value.items()}
            return [Path(path).name for path in value] if isinstance(value, list) else Path(value).name

        plain = self.job | {k: name_of(self.job[k]) for k in ("beds", "model", "cases") if k in self.job}
        text = json.dumps([plain, self.seconds, *conditions], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:12]
        return re.sub(r"[^\w.+-]+", "-", self.name).strip("-") + f"-{digest}"


class Contest:
    """A scene, the state that all start from, and everyone who answers for it; model files are by their shown name."""

    def __init__(self, config: BenchmarkConfig, models: dict[str, Path]) -> None:
        self.config, self.models, data = config, models, config.dataset
        self.rpm, scene = float(data.holdout_speeds_rpm[0]), build_scene(config.scene)
        self.takes_speeds = scene.takes_speeds  # or it keeps its own motion
        self.scene = scene.at_speed(self.rpm) if self.takes_speeds else scene
        # The run of the DEM whose settled state all methods start from: a packing that no training saw.
        self.case = CaseSpec(self.scene, config.dem, data.unseen_packing_seed)
        # What errors are measured from: nudged runs of the DEM at half its automatic step.
        self.replicas = replicas(half_step(self.case), data.replicas)
        # What errors are measured in where nudges hardly grow: as many other packings, beside the first replica.
        seeds = range(data.unseen_packing_seed + 1, data.unseen_packing_seed + data.replicas)
        others = [replace(half_step(self.case), packing_seed=seed) for seed in seeds]
        self.packings = [self.replicas[0], *others]
        # The training speeds below and above, rpm, from the packing of training; none where a side lacks one.
        found = neighbouring_speeds(self.rpm, data.training_speeds_rpm) if self.takes_speeds else None
        self.neighbours = {rpm: CaseSpec(scene.at_speed(rpm), config.dem, data.packing_seed) for rpm in found or ()}
        self._studied = self.takes_speeds and scene.name in config.profile.study_scenes
        counts = sorted(config.profile.counts) if self._studied else []
        self._count_cases = {count: self._count_case(count) for count in counts}
        # By factor: cases of several packings, so that the error averages over them; or why there is none.
        self._coarse = {factor: self._coarse_cases(factor) for factor in config.profile.coarse_graining}
        coarse = [case for cases in self._coarse.values() if not isinstance(cases, str) for case in cases]
        self.cases = [*self.replicas, *self.neighbours.values()]
        self.beds = [*self._count_cases.values(), *coarse]  # of which the settled bed alone is needed
        self.automatic = next(self._dem_ladder([1.0])).name  # the DEM that all times are held against

    @property
    def methods(self) -> list[Method]:
        """Everyone who is compared, those who do not fit included."""
        profile = self.config.profile
        found = [*self._dem_ladder(profile.step_multiples)]
        found += self._dem_ladder(profile.single_multiples, precision="float32")
        for modulus in profile.soft_moduli:
            if modulus < self.scene.material.youngs_modulus:
                found += self._dem_ladder(profile.soft_multiples, modulus)
        found += [*self._coarse_ladder()]
        if profile.numpy_frames:
            step, _ = choose_time_step(self.scene)
            job = self._dem_job(self.case, DemConfig(engine="numpy", time_step=step))
            name, seconds = f"DEM {1e3 * step:.3g} ms, numpy engine", profile.numpy_frames * self.scene.frame_interval
            found.append(Method(name, "dem", job, seconds, judged=False))
        found += [self._model(name, self.case) for name in self.models]
        found += [*self._baselines()]
        return list({method.name: method for method in found}.values())  # two multiples may round to one step

    @property
    def stiffness_methods(self) -> Study:
        """What is timed against stiffness: by label, the modulus (Pa) and the method there."""
        home, moduli = self.scene.material.youngs_modulus, sorted(self.config.profile.stiffness)
        if not (self._studied and moduli):
            return {}
        found: Study = {"automatic": [], "largest": []}
        for modulus in moduli:
            scene = with_modulus(self.scene, modulus)
            # The bed is led to a stiffer material by factors of ten.
            stages = [home * 10.0**k for k in range(1, 9) if home * 10.0**k < modulus] + [modulus] * (modulus > home)
            for label, step in (("automatic", None), ("largest", largest_allowed_step(scene))):
                dem = replace(self.config.dem, time_step=step, threads=1)
                job = self._dem_job(self.case, dem, scene, stages)
                found[label].append((modulus, self._short(f"E = {modulus:g} Pa, {label} step", "dem", job)))
        for method in self._fitting(self.case):
            found[method.name] = [(home, self._short(method.name, "surrogate", method.job))]
        return found

    @property
    def count_methods(self) -> Study:
        """What is timed against the number of spheres: by label, the number and the method there."""
        found: Study = {}
        for count, case in self._count_cases.items():
            job = self._dem_job(case, replace(self.config.dem, threads=1))
            found.setdefault("DEM", []).append((count, self._short(f"DEM, {count} spheres", "dem", job)))
            for method in self._fitting(case):
                short = self._short(f"{method.name}, {count} spheres", "surrogate", method.job)
                found.setdefault(method.name, []).append((count, short))
        return found

    def _fitting(self, case: CaseSpec) -> list[Method]:
        """The surrogates that answer for a case."""
        found = [self._model(name, case) for name in self.models]
        return [one for one in found if one.kind == "surrogate" and not one.unfit_because]

    def _dem_ladder(
        self, multiples: list[float], modulus: float | None = None, precision: str = "float64"
    ) -> Iterator[Method]:
        """The fast engine at multiples of its automatic step, also beyond what is safe."""
        scene = self.scene if modulus is None else with_modulus(self.scene, modulus)
        automatic, _ = choose_time_step(scene)
        for multiple in multiples:
            step = dividing_step(scene.frame_interval, multiple * automatic)
            dem = replace(self.config.dem, time_step=step, threads=1, engine="numba")
            dem = replace(dem, precision=precision, allow_unsafe_step=True)
            words = [f"DEM {1e3 * step:.3g} ms"]
            words += [f"E = {modulus:.0e} Pa".replace("e+0", "e")] if modulus is not None else []
            words += ["float32"] if precision == "float32" else []
            yield self._whole(", ".join(words), "dem", self._dem_job(self.case, dem, scene))

    def _coarse_ladder(self) -> Iterator[Method]:
        """The fast engine on coarser spheres, each at its automatic step and at its largest."""
        for factor, cases in self._coarse.items():
            if isinstance(cases, str):
                yield Method(f"DEM, coarse-grained {factor:g}", "dem", {}, 0.0, unfit_because=cases)
                continue
            scene, beds = cases[0].scene, [self._bed(case) for case in cases]
            for step in (choose_time_step(scene)[0], largest_allowed_step(scene)):
                dem = replace(self.config.dem, time_step=step, threads=1, engine="numba")
                name = f"DEM {1e3 * step:.3g} ms, coarse-grained {factor:g}"
                yield self._whole(name, "dem", self._dem_job(cases[0], dem) | {"beds": beds})

    def _coarse_cases(self, factor: float) -> list[CaseSpec] | str:
        try:
            first = replace(self.case, scene=self.scene.coarse_grained(factor))
        except SceneError as error:
            return str(error)
        return [replace(first, packing_seed=first.packing_seed + k) for k in range(COARSE_PACKINGS)]

    def _dem_job(
        self, case: CaseSpec, dem: DemConfig, scene: Scene | None = None, stages: list[float] | None = None
    ) -> dict[str, Any]:
        return self._job("dem", case, scene) | {"dem": asdict(dem), "stages": stages or []}

    def _job(self, does: str, case: CaseSpec, scene: Scene | None = None) -> dict[str, Any]:
        return {"does": does, "scene": to_document(scene or case.scene), "beds": [self._bed(case)]}

    def _bed(self, case: CaseSpec) -> str:
        return str(case.settled_path(self.config.dataset.root))

    def _model(self, name: str, case: CaseSpec) -> Method:
        """A surrogate, or an emulator, which gives statistics alone."""
        path, scene = self.models[name], case.scene
        card, weights = load_card(path)
        kind, beyond = "surrogate", ""
        if (known := MODELS.get(card.model["name"])) is not None and not known.particles:
            kind, emulator = "emulator", emulator_of(card, weights, path)
            unfit = why_no_statistics(emulator, card, scene, case.packing_seed)
            beyond = "" if unfit else "; ".join(emulator.extrapolations(scene))
        else:
            unfit = why_unfit(card, scene, case.packing_seed)
        job = self._job(kind, case) | {"model": str(path), "weights": file_digest(path)}
        spent = (float(card.origin.get(key, 0.0)) for key in ("data_seconds", "seconds"))
        span = scene.end_time - scene.start_time
        return Method(name, kind, job, span, *spent, unfit_because=unfit, beyond=beyond)

    def _baselines(self) -> Iterator[Method]:
        for name in BASELINES:
            yield self._whole(name, "baseline", self._job(name, self.case))
        if not self.neighbours:
            reason = "there are no runs of this scene at a lower and at a higher speed"
            yield Method("interpolation", "baseline", {}, 0.0, unfit_because=reason)
            return
        paths = {f"{rpm:g}": str(case.path(self.config.dataset.root)) for rpm, case in self.neighbours.items()}
        spent = [read_attributes(path) for path in map(Path, paths.values()) if path.exists()]
        seconds = sum(float(facts["wall_seconds"]) for facts in spent)
        seconds += max((float(facts["settling_wall_seconds"]) for facts in spent), default=0.0)
        job = {"does": "interpolation", "cases": paths, "rpm": self.rpm}
        method = self._whole(f"interpolation, {' and '.join(paths)} rpm", "baseline", job)
        yield replace(method, data_seconds=seconds)

    def _whole(self, name: str, kind: str, job: dict[str, Any]) -> Method:
        return Method(name, kind, job, self.scene.end_time - self.scene.start_time)

    def _short(self, name: str, kind: str, job: dict[str, Any]) -> Method:
        return Method(name, kind, job, self.config.profile.study_frames * self.scene.frame_interval, judged=False)

    def _count_case(self, count: int) -> CaseSpec:
        """A drum of another length, filled as high, that runs only as long as it is timed."""
        config, profile = self.config.scene, self.config.profile
        # In a short one the first lattice would not fit between the caps.
        more = config.filling.diameter if count < config.filling.count else 0.0
        length = config.container.length * count / config.filling.count + more
        end = config.start_time + profile.study_frames * config.frame_interval
        container, filling = replace(config.container, length=length), replace(config.filling, count=count)
        changed = replace(config, name=f"{config.name}_{count}", container=container, filling=filling, end_time=end)
        scene = build_scene(changed)
        return CaseSpec(scene.at_speed(self.rpm), self.config.dem, self.config.dataset.unseen_packing_seed)


def why_unfit(card: ModelCard, scene: Scene, packing_seed: int) -> str:
    """Why the model of a card cannot answer for a scene from a packing, or may not; empty where it can."""
    home = _home(card)
    if scene.needs.polydispersity:
        return "it knows spheres of one size alone"
    if len(scene.materials) > 1:
        return "it knows one material alone"
    if scene.filling.largest_radius != home.filling.largest_radius:
        return "it was trained with another diameter"
    for name in ("frame_interval", "gravity", "material", "wall_material"):
        if getattr(scene, name) != getattr(home, name):
            return f"it was trained with another {name.replace('_', ' ')}"
    return _why_unfair(card, scene, packing_seed)


def why_no_statistics(emulator: Emulator, card: ModelCard, scene: Scene, packing_seed: int) -> str:
    """Why an emulator with a card cannot answer for a scene from a packing, or may not; empty where it can."""
    home, material = _home(card), scene.material
    if scene.needs.polydispersity or len(scene.materials) > 1:
        return "it knows spheres of one size and one material alone"
    try:
        emulator.refuse(scene, np.zeros(2))  # the angles of the settled bed are not known before there is one
    except ValueError as error:
        return str(error).removeprefix(f"scene {scene.name!r}").lstrip(": ")
    # Friction is one of its inputs.
    alike = replace(home.material, friction=material.friction), replace(home.wall_material, friction=material.friction)
    if (scene.gravity, material, scene.wall_material) != (home.gravity, *alike):
        return "it was trained with another material or gravity"
    return _why_unfair(card, scene, packing_seed)


def _home(card: ModelCard) -> Scene:
    return build_scene(read_config(SceneConfig, card.scene))


def _why_unfair(card: ModelCard, scene: Scene, packing_seed: int) -> str:
    """Whether a model has seen the speed or the packing that it would be judged on."""
    # The other sense of rotation is the mirror image.
    speeds = set(map(abs, scene.rotation.speeds_rpm))
    if scene.takes_speeds and speeds & set(map(abs, card.origin.get("training_speeds_rpm", ()))):
        return f"it was trained at {max(speeds):g} rpm"
    seen = [card.origin.get("packing_seed")] if scene.takes_speeds else card.origin.get("training_packings", ())
    if packing_seed in seen:
        return f"it was trained on packing {packing_seed}"
    return ""
