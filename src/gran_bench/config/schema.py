"""Every config key: name, type, default, unit, bounds. ``conf/`` chooses values, ``reading`` reads them into these."""

from __future__ import annotations  # the types of keys are read as words

from dataclasses import dataclass, field

from gran_bench.config.convolution import CconvModelConfig, Lu2021Config, XuShen2022Config
from gran_bench.config.emulator import EmulatorConfig
from gran_bench.config.graph import GnsConfig
from gran_bench.config.registry import holds_weights, register_model, register_wall
from gran_bench.config.requirements import RequirementsConfig
from gran_bench.config.rules import MISSING, Name, Range, Section, at_least, between, key, one_of, positive
from gran_bench.config.trainer import TrainerConfig

FRACTION, RESTITUTION, SEED = Range(0.0, 1.0), Range(0.0, 1.0, open_low=True), at_least(0)
BACKEND, FRAME_WEIGHTS = one_of("fused", "torch"), one_of("uniform", "discounted", "inverse", "rising")


@dataclass
class MaterialConfig(Section, place="scene.material"):
    """An elastic, frictional material (Hertz–Mindlin)."""

    youngs_modulus: float = key(1.0e7, positive("Pa"))
    poisson_ratio: float = key(0.29, between(-1, 0.5))
    density: float = key(2500.0, positive("kg/m³"))
    restitution: float = key(0.5, RESTITUTION)
    friction: float = key(0.3, at_least(0))  # sliding, particle and wall
    rolling_friction: float = key(0.0, at_least(0))  # elastic-plastic, type C; 0 switches it off


@register_wall("none", build="gran_bench.scene.build:open_space")
@register_wall("drum", build="gran_bench.scene.build:drum", drum=True)
@dataclass
class ContainerConfig(Section, place="scene.container"):
    """The analytic walls: a horizontal drum about the y axis, centred on the origin, or none."""

    kind: str = key("drum", one_of("drum", "none"))
    diameter: float = key(1.0, positive("m"))
    length: float = key(1.0, positive("m"))  # along y
    periodic_axis: bool = False  # true: no end caps, y wraps around


@register_wall("box", build="gran_bench.scene.build:closed_box")
@dataclass
class BoxConfig(Section, place="scene.container"):
    """A closed box that stands on z = 0."""

    kind: str = key("box", one_of("box"))
    width: float = key(1.0, positive("m"))  # along x
    length: float = key(1.0, positive("m"))  # along y
    height: float = key(1.0, positive("m"))  # along z


@register_wall("hopper", build="gran_bench.scene.build:hopper")
@dataclass
class HopperConfig(Section, place="scene.container"):
    """A conical hopper: an upright tube above a cone with an orifice at z = 0, closed until the scene starts."""

    kind: str = key("hopper", one_of("hopper"))
    diameter: float = key(0.5, positive("m"))  # of the tube
    height: float = key(1.0, positive("m"))  # of the tube
    half_angle_deg: float = key(45.0, between(0, 90, "degrees"))  # between the cone and the vertical
    orifice: float = key(0.2, positive("m"))  # diameter of the opening
    outlet_depth: float = key(0.1, positive("m"))  # under the orifice; a sphere beyond counts as discharged


@dataclass
class SizesConfig(Section, place="scene.filling.sizes"):
    """Distribution of the diameters as factors of filling.diameter, by number or by mass."""

    kind: str = key("one", one_of("one", "listed", "uniform", "lognormal", "histogram"))
    by: str = key("number", one_of("number", "mass"))  # what fractions and spread are of; sieve curves are by mass
    factors: list[float] = key([], positive())  # of listed
    edges: list[float] = key([], positive())  # of histogram, rising; uniform between two of them
    fractions: list[float] = key([], FRACTION)  # share of each factor, or between two edges, sum 1
    spread: float = key(0.0, Range(0.0, 1.0, open_high=True))  # half-width; of lognormal σ of ln d, cut at 2 σ


@dataclass
class FillingConfig(Section, place="scene.filling"):
    """How many spheres, how large, of which material, and how they start."""

    count: int = key(3000, at_least(0))
    diameter: float = key(0.05, positive("m"))  # d of all `_diameters`, of fall times √(d/g), Froude numbers v/√(g d)
    lattice_spacing: float = key(1.12, at_least(1, "diameters"))
    jitter: float = key(0.05, at_least(0, "diameters"))  # uniform in ±jitter
    settled_froude: float = key(1.428e-3, positive())  # rms; a bed that stays below is at rest
    settled_speed: float | None = key(None, positive("m/s"))  # null: by settled_froude
    longest_settling_fall_times: float = key(280.0, positive("√(d/g)"))  # an error beyond
    longest_settling: float | None = key(None, positive("s"))  # null: by longest_settling_fall_times
    settles: bool = True  # false: the scene starts with the spheres where and as fast as they are put
    sizes: SizesConfig = field(default_factory=SizesConfig)
    second_fraction: float = key(0.0, FRACTION)  # share of spheres of scene.second_material, by number
    positions: list[list[float]] = key([], Range(unit="m"))  # of each sphere; empty: a lattice
    velocities: list[list[float]] = key([], Range(unit="m/s"))  # of placed spheres; empty: at rest
    spins: list[list[float]] = key([], Range(unit="rad/s"))  # of placed spheres; empty: none
    radii: list[float] = key([], positive("m"))  # of placed spheres; empty: by diameter and sizes
    expansion: float = key(0.0, Range(unit="1/s"))  # H of a start with velocity H × position


@dataclass
class MixedConfig(Section, place="scene.mixed"):
    """Contacts between the two particle materials; null: the geometric mean of the two materials' own."""

    restitution: float | None = key(None, RESTITUTION)
    friction: float | None = key(None, at_least(0))
    rolling_friction: float | None = key(None, at_least(0))


@dataclass
class RotationConfig(Section, place="scene.rotation"):
    """Rotation about +y: piecewise linear between knots, constant after the last, at rest before the first."""

    times: list[float] = key([1.5], Range(unit="s"))
    speeds_rpm: list[float] = key([30.0], Range(unit="rpm"))


@dataclass
class SceneConfig(Section, place="scene"):
    """A scene: container, filling, material, gravity, schedule."""

    name: str = key(MISSING, Name())
    container: ContainerConfig | BoxConfig | HopperConfig = field(default_factory=ContainerConfig)  # by its kind
    filling: FillingConfig = field(default_factory=FillingConfig)
    material: MaterialConfig = field(default_factory=MaterialConfig)
    wall_material: MaterialConfig | None = None  # null: the particles' material, as is each key left out
    second_material: MaterialConfig | None = None  # of further spheres; what it leaves out is the first's
    mixed: MixedConfig = field(default_factory=MixedConfig)
    gravity: list[float] = key([0.0, 0.0, -9.81], Range(unit="m/s²"))
    rotation: RotationConfig = field(default_factory=RotationConfig)
    start_time: float = key(1.5, at_least(0, "s"))  # label of the settled state
    end_time: float = key(5.5, positive("s"))
    frame_interval: float = key(0.01, positive("s"))
    coarse_graining: float = key(1.0, at_least(1))  # f: N/f³ spheres of f d for N of d, of the same material
    coarse_friction: float | None = key(None, at_least(0))  # sliding, of coarse spheres; null: the material's
    coarse_rolling_friction: float | None = key(None, at_least(0))  # of coarse spheres; null: the material's


@dataclass
class DemConfig(Section, place="dem"):
    """The solver."""

    engine: str = key("numba", one_of("numba", "numpy", "lammps"))
    time_step: float | None = key(None, positive("s"))  # null: a stated fraction of min(Rayleigh time, contact time)
    skin: float | None = key(None, positive("m"))  # Verlet; null: chosen by the clock; changes no bit
    threads: int | None = key(None, at_least(1))  # of numba; null: chosen by the clock; changes no bit
    ranks: int = key(1, at_least(1))  # of lammps: processes under MPI; they change the order of sums
    precision: str = key("float64", one_of("float64", "float32"))  # of contact forces; positions stay float64
    slip: str = key("contact_point", one_of("contact_point", "full_radius"))  # the arms of spins; full_radius: LAMMPS's
    power: bool = False  # torque, power, losses and impact spectra of each frame; changes no bit of the trajectory
    allow_unsafe_step: bool = False  # true turns the error of a too large step into a recorded warning


@dataclass
class DatasetConfig(Section, place="dataset"):
    """Which cases are made, and which may be seen by training; speeds below 0 turn the other way, the mirror image."""

    root: str = "data"  # folder of the HDF5 cases, relative to where the command runs
    files: list[str] = field(default_factory=list)  # imported cases or folders of them; empty: the DEM makes the cases
    training_speeds_rpm: list[float] = key([20.0, 25.0, 35.0, 40.0, 50.0, 60.0], Range(unit="rpm"))
    validation_speeds_rpm: list[float] = key([], Range(unit="rpm"))  # held out of training, used to choose
    holdout_speeds_rpm: list[float] = key([30.0], Range(unit="rpm"))  # never read in training
    packing_seed: int = key(0, SEED)  # the judged filling, which all cases of a drum share
    unseen_packing_seed: int = key(1, SEED)  # the filling that only judging sees
    training_packings: list[int] = key([], SEED)  # fillings to train on in a scene that keeps its own motion
    replicas: int = key(5, at_least(2))  # nudged runs of the held-out case for the noise floor
    workers: int = key(2, at_least(1))  # cases made at a time


@register_model(
    "contact",
    build="gran_bench.surrogate.contact.network:ContactNetwork",
    spin=True,
    conserves_momentum=True,
    code=("surrogate/contact",),
)
@dataclass
class ContactModelConfig(Section, place="model"):
    """The contact network (DESIGN: a learned solver of contacts)."""

    name: str = key("contact", one_of("contact"))
    iterations: int = key(8, at_least(1))
    hidden: int = key(16, at_least(1))
    channels: int = key(4, at_least(1))
    radius_diameters: float = key(1.2, positive("diameters"))  # reach of a pair
    radius_m: float | None = key(None, positive("m"))  # null: by radius_diameters
    wall_reach_diameters: float = key(0.2, positive("diameters"))  # gap up to which a wall contact is listed
    wall_reach_m: float | None = key(None, positive("m"))  # null: by wall_reach_diameters
    memory: bool = False  # carry a tangential spring vector of each contact from frame to frame
    velocity: str = key("mean", one_of("mean", "instantaneous"))  # what the state's velocity is
    backend: str = key("fused", BACKEND)  # fused: Numba, CPU


@dataclass
class BoundaryConfig(Section, place="boundary"):
    """How a model sees the walls: a convolution in one of three ways, the contact network in its own."""

    kind: str = key("spheres", one_of("none", "spheres", "analytic", "own"))  # own: of the contact network
    spacing: float = key(0.5, positive("diameters"))  # of wall spheres
    normal: bool = True  # wall normals among the features
    velocity: bool = True  # wall velocities among the features


@holds_weights
@dataclass
class LossConfig(Section, place="loss"):
    """Weights of the terms; a term of weight 0 is not computed."""

    position_l2: float = key(1.0, at_least(0))
    position_mse: float = key(0.0, at_least(0))
    huber: float = key(0.0, at_least(0))
    velocity: float = key(0.0, at_least(0))
    acceleration: float = key(0.0, at_least(0))
    spin: float = key(0.0, at_least(0))
    overlap: float = key(0.0, at_least(0))
    momentum: float = key(0.0, at_least(0))
    cell_displacement: float = key(0.0, at_least(0))  # mean displacement in cells of the cross-section, 2 d wide
    center_of_mass: float = key(0.0, at_least(0))
    energy: float = key(0.0, at_least(0))
    speed_distribution: float = key(0.0, at_least(0))
    frame_weights: str = key("uniform", FRAME_WEIGHTS)
    spin_frame_weights: str = key("uniform", FRAME_WEIGHTS)  # of the spin term alone
    discount: float = key(0.8, Range(0.0, 1.0, open_low=True))  # γ of `discounted`


@dataclass
class RolloutConfig(Section, place="rollout"):
    """How far training looks ahead."""

    frames: int = key(3, at_least(1))  # F
    final_frames: int | None = key(None, at_least(1))  # F from `final_from` of the budget on; null: F
    final_from: float = key(0.6, FRACTION)  # fraction of the steps
    growth: str = key("jump", one_of("jump", "linear"))  # how F gets from `frames` to `final_frames`
    gradient_through_time: bool = True
    noise_diameters: float = key(0.0, at_least(0, "diameters"))  # Gaussian, on the first frame's position
    noise_m: float | None = key(None, at_least(0, "m"))  # null: by noise_diameters
    independent_noise: bool = False  # own noise on velocity × Δt and spin × r × Δt; false: the velocity implied
    mirror: bool = False  # random reflection along the drum's axis
    rotation: bool = False  # each window turned at random, gravity and walls with it; about y where y is periodic


@dataclass
class OptimConfig(Section, place="optim"):
    """Adam and its learning rate."""

    learning_rate: float = key(1.0e-4, positive())
    final_learning_rate: float = key(2.0e-6, positive())
    schedule: str = key("steps", one_of("steps", "cosine", "constant"))
    decay_steps: int = key(8, at_least(1))  # number of equal drops of `steps`
    warmup_steps: int = key(0, at_least(0))
    accumulate: int = key(5, at_least(1))  # windows whose gradients make one update
    gradient_clip: float | None = key(None, positive())  # norm; null: off
    weight_average: float = key(0.0, Range(0.0, 1.0, open_high=True))  # decay of the exponential average; 0: off


@dataclass
class JudgeConfig(Section, place="judge"):
    """What is rolled out and judged after training."""

    speeds_rpm: list[float] | None = key(None, Range(unit="rpm"))  # null: the judged one and its training neighbours
    unseen_packing: bool = True
    short_horizon_starts: int = key(20, at_least(1))  # start frames of the 1, 3, 10 frame position errors
    gif: bool = True
    scenes: list[str] = key(["drum_ramp", "drum_stop"], Name())  # whose schedules an emulator is judged on
    random_schedules: int = key(12, at_least(0))  # that an emulator is judged on
    requirements: RequirementsConfig = field(default_factory=RequirementsConfig)


@dataclass
class TrackingConfig(Section, place="tracking"):
    """Where runs are recorded."""

    experiment: str = "gran-bench"
    root: str = "results"  # folder of the database, the artifacts and the run folders
    folder: str | None = key(None, Name())  # of this run in <root>/runs/, before its key; null: recipe, changes
    sweep: str | None = key(None, Name())  # folder in <root>/sweeps/; null: recipe, changes
    parent: str | None = None  # id of the MLflow run that this one belongs to; a sweep sets it
    enabled: bool = True


@dataclass
class GenerateConfig(Section):
    """Everything that `python -m gran_bench.generate` reads."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    dem: DemConfig = field(default_factory=DemConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    dry_run: bool = False  # true: say what the command will do and take, and make nothing


@dataclass
class TrainConfig(GenerateConfig):
    """Everything that `python -m gran_bench.train` reads."""

    experiment: str = key("default", Name())  # first word of the run's folder and of its MLflow run
    seed: int = key(0, SEED)
    device: str = key("auto", one_of("auto", "cpu", "cuda"))
    threads: int = key(2, at_least(1))  # CPU threads of the surrogate
    model: ContactModelConfig | CconvModelConfig | Lu2021Config | XuShen2022Config | GnsConfig | EmulatorConfig = field(
        default_factory=ContactModelConfig
    )
    boundary: BoundaryConfig = field(default_factory=lambda: BoundaryConfig(kind="own"))  # of the contact network
    loss: LossConfig = field(default_factory=LossConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)


@dataclass
class EvaluateConfig(Section):
    """Everything that `python -m gran_bench.evaluate` reads; the scene is the one that the model was made for."""

    checkpoint: str = MISSING  # model file; `shipped`: the one in the package
    device: str = key("auto", one_of("auto", "cpu", "cuda"))
    dry_run: bool = False  # true: say what the command will do and take, and make nothing
    dem: DemConfig = field(default_factory=DemConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)


@dataclass
class ProfileConfig(Section, place="profile"):
    """How thoroughly methods are compared."""

    name: str = key("quick", Name())  # of the folder of the results
    rounds: int = key(5, at_least(1))  # timed runs of every method, in turns
    judged_rounds: int = key(5, at_least(1))  # of these, from the first on, whose error is measured
    step_multiples: list[float] = key([0.5, 1.0, 2.0, 3.5, 5.0], positive("automatic steps"))
    single_multiples: list[float] = key([2.0], positive("automatic steps"))  # the same with float32 contact forces
    soft_moduli: list[float] = key([1.0e7, 1.0e6, 1.0e5], positive("Pa"))  # where softer than the scene
    soft_multiples: list[float] = key([1.0, 2.0], positive("automatic steps"))  # of a softened DEM's own automatic step
    coarse_graining: list[float] = key([1.26, 1.5, 2.0, 2.5], Range(1.0, open_low=True))  # f; empty: none
    numpy_frames: int = key(2, at_least(0))  # that the readable engine is timed over; 0: not at all
    stiffness: list[float] = key([1.0e7, 1.0e8, 1.0e9, 7.0e10], positive("Pa"))  # empty: no such study
    counts: list[int] = key([300, 1000, 3000, 6000], at_least(1))  # spheres; empty: no such study
    study_scenes: list[str] = field(default_factory=lambda: ["drum"])  # names of the scenes that these two are made for
    study_frames: int = key(10, at_least(1))  # of each run in these two studies
    study_rounds: int = key(3, at_least(1))  # of these two studies


@dataclass
class BenchmarkConfig(GenerateConfig):
    """Everything that `python -m gran_bench.benchmark` reads."""

    profile: ProfileConfig = field(default_factory=ProfileConfig)
    models: list[str] = field(default_factory=lambda: ["shipped"])  # model files; `shipped`: the one in the package
    seed: int = key(0, SEED)  # of the order of turns, and of the nudge of each round
    measure: bool = True  # false: tables, figures and page anew from kept results, by today's rules
    root: str = "results/benchmark"  # folder of results and page, from where the command runs
