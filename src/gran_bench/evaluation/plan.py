"""What a model is judged on: speeds, packings, and the runs of the DEM that it is held against."""

from dataclasses import dataclass, replace

from gran_bench.baselines import nearest_speeds
from gran_bench.config import DatasetConfig, DemConfig, JudgeConfig
from gran_bench.dataset import CaseSpec, case_at, half_step, imported_replicas, replicas
from gran_bench.dem.simulate import choose_time_step
from gran_bench.scene import Scene

NEIGHBOURS = 2  # training speeds on either side of the judged one that are rolled out where none are chosen
COARSER = 2.0  # the large step of the DEM as a rival, in production steps


@dataclass(frozen=True)
class Plan:
    """What is rolled out and what it is held against.

    Where the data set has a validation speed, that one is judged, and the held-out speed is neither rolled out nor
    opened: whoever chooses must not see it.

    A scene that keeps its own motion has no speeds: its judged case has ``None`` for one. The model saw neither of its
    two packings, ``dataset.packing_seed`` and ``dataset.unseen_packing_seed``.
    """

    scene: Scene  # without a speed of its own
    dem: DemConfig
    dataset: DatasetConfig
    judge: JudgeConfig

    @property
    def validates(self) -> bool:
        """Whether the judged speed is a validation speed."""
        return self.scene.takes_speeds and bool(self.dataset.validation_speeds_rpm)

    @property
    def judged_rpm(self) -> float | None:
        """The speed that is judged against replicas, rpm."""
        if not self.scene.takes_speeds:
            return None
        speeds = self.dataset.validation_speeds_rpm if self.validates else self.dataset.holdout_speeds_rpm
        return float(speeds[0])

    @property
    def speeds_rpm(self) -> list[float | None]:
        """Every speed that is rolled out from the shared packing, rpm."""
        if self.judged_rpm is None:
            return [None]
        hidden = set(self.dataset.holdout_speeds_rpm) if self.validates else set()
        chosen = self.judge.speeds_rpm
        if chosen is None:
            chosen = nearest_speeds(self.judged_rpm, self.dataset.training_speeds_rpm, NEIGHBOURS)
        return sorted({*chosen, self.judged_rpm} - hidden)

    @property
    def packings(self) -> list[bool]:
        """Whether the judged packings are unseen: the shared one is not, and stands first."""
        return [False, True] if self.judge.unseen_packing else [False]

    def case(self, rpm: float | None, unseen: bool = False) -> CaseSpec:
        """The DEM's case at a speed, from the shared or the unseen packing."""
        return self._case(self.scene, rpm, unseen)

    def judged_case(self, unseen: bool = False) -> CaseSpec:
        """The DEM's case that errors are measured from: of the fine spheres, where the scene's are coarse-grained."""
        return self._case(self.scene.fine, self.judged_rpm, unseen)

    def _case(self, scene: Scene, rpm: float | None, unseen: bool) -> CaseSpec:
        seed = self.dataset.unseen_packing_seed if unseen else self.dataset.packing_seed
        return case_at(scene if rpm is None else scene.at_speed(rpm), self.dem, self.dataset, seed)

    def replicas(self, unseen: bool) -> list[CaseSpec]:
        """The nudged runs of the judged case that give the noise floor."""
        case = self.judged_case(unseen)
        return imported_replicas(case, self.dataset) if self.imported else replicas(case, self.dataset.replicas)

    @property
    def imported(self) -> bool:
        """Whether another code made the cases, so that none can be made with another step or packing."""
        return bool(self.dataset.files)

    @property
    def finer(self) -> CaseSpec:
        """The judged case with half the time step."""
        return half_step(self.judged_case())

    @property
    def coarser(self) -> CaseSpec:
        """The judged case with twice the time step: the DEM as a rival in speed."""
        spec = self.judged_case()
        step, _ = choose_time_step(spec.scene, self.dem.time_step, self.dem.allow_unsafe_step)
        return replace(spec, dem=replace(self.dem, time_step=COARSER * step), settling_dem=self.dem)

    @property
    def neighbours_rpm(self) -> tuple[float, float] | None:
        """The training speeds below and above the judged one, rpm; None where a side has none."""
        found = self.replayed_rpm
        return (found[0], found[1]) if len(found) == 2 else None

    @property
    def replayed_rpm(self) -> list[float]:
        """The training speeds next to the judged one, on one side or both, whose runs a model must be better than."""
        trained = self.dataset.training_speeds_rpm
        return [] if self.judged_rpm is None else nearest_speeds(self.judged_rpm, trained, 1)

    @property
    def cases(self) -> list[CaseSpec]:
        """Every run of the DEM that judging needs."""
        judged = [self.judged_case(unseen) for unseen in (self.packings if self.imported else (False, True))]
        speeds = [self.case(rpm) for rpm in {*self.speeds_rpm, *self.replayed_rpm}]
        doubles = [spec for unseen in self.packings for spec in self.replicas(unseen)]
        own = [self.case(self.judged_rpm, unseen) for unseen in self.packings] if self.scene.fine_spheres else []
        return [*own, *speeds, *judged, *doubles, *([] if self.imported else [self.finer, self.coarser])]


def rollout_name(rpm: float | None, unseen: bool = False) -> str:
    """``30rpm``, or ``30rpm_unseen`` from the unseen packing; ``own_motion`` where the scene keeps its own."""
    return ("own_motion" if rpm is None else f"{rpm:g}rpm") + "_unseen" * unseen


def motion_words(rpm: float | None) -> str:
    """The judged motion for people: ``30 rpm``, or ``own motion``."""
    return "own motion" if rpm is None else f"{rpm:g} rpm"


def packing_words(packing: str, rpm: float | None) -> str:
    """A judged packing for people, ``shared`` or ``unseen``; where the scene keeps its own motion both are unseen."""
    return f"{packing if rpm is not None else {'shared': 'first'}.get(packing, 'second')} packing"
