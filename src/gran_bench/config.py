"""The schema of every config key: name, type, default, unit.

The dataclasses below are the only place where a key may be declared. ``conf/`` chooses values, Hydra composes them,
``config_rules`` says which values are legal and ``config_check`` reads a composed config into these classes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

MISSING = "???"  # Hydra's mark of a value that the user must choose


@dataclass
class MaterialConfig:
    """An elastic, frictional material (Hertz–Mindlin)."""

    youngs_modulus: float = 1.0e7  # Pa
    poisson_ratio: float = 0.29
    density: float = 2500.0  # kg/m³
    restitution: float = 0.5
    friction: float = 0.3  # sliding, particle and wall
    rolling_friction: float = 0.0  # elastic-plastic, type C; 0 switches it off


@dataclass
class ContainerConfig:
    """The analytic walls: a horizontal drum about the y axis, centred on the origin, or none."""

    kind: str = "drum"  # drum | none
    diameter: float = 1.0  # m
    length: float = 1.0  # m, along y
    periodic_axis: bool = False  # true: no end caps, y wraps around


@dataclass
class BoxConfig:
    """A closed box that stands on z = 0."""

    kind: str = "box"
    width: float = 1.0  # m, along x
    length: float = 1.0  # m, along y
    height: float = 1.0  # m, along z


@dataclass
class HopperConfig:
    """A conical hopper: an upright tube above a cone with an orifice at z = 0, closed until the scene starts."""

    kind: str = "hopper"
    diameter: float = 0.5  # m, of the tube
    height: float = 1.0  # m, of the tube
    half_angle_deg: float = 45.0  # degrees between the cone and the vertical
    orifice: float = 0.2  # m, diameter of the opening
    outlet_depth: float = 0.1  # m under the orifice: where a sphere counts as discharged and is followed no more


# The schema that a container's kind selects; a drum where none is said.
CONTAINER_SCHEMAS: dict[str, type] = {
    "drum": ContainerConfig,
    "none": ContainerConfig,
    "box": BoxConfig,
    "hopper": HopperConfig,
}


@dataclass
class SizesConfig:
    """Distribution of the diameters, by number, as factors of filling.diameter."""

    kind: str = "one"  # one | listed | uniform | lognormal
    factors: list[float] = field(default_factory=list)  # of listed
    fractions: list[float] = field(default_factory=list)  # share of each factor, sum 1
    spread: float = 0.0  # half-width of uniform, standard deviation of ln d of lognormal (cut at two of them)


@dataclass
class FillingConfig:
    """How many spheres, how large, of which material, and how they start."""

    count: int = 3000
    diameter: float = 0.05  # m
    lattice_spacing: float = 1.12  # in diameters
    jitter: float = 0.05  # in diameters, uniform in ±jitter
    settled_speed: float = 1.0e-3  # m/s, mean speed below which a bed is at rest
    longest_settling: float = 20.0  # s, an error beyond
    settles: bool = True  # false: the scene starts with the spheres where and as fast as they are put
    sizes: SizesConfig = field(default_factory=SizesConfig)
    second_fraction: float = 0.0  # share of spheres of scene.second_material, by number
    positions: list[list[float]] = field(default_factory=list)  # m, of each sphere; empty: a lattice
    velocities: list[list[float]] = field(default_factory=list)  # m/s, of placed spheres; empty: at rest
    spins: list[list[float]] = field(default_factory=list)  # rad/s, of placed spheres; empty: none
    expansion: float = 0.0  # 1/s, H of a start with velocity H × position


@dataclass
class MixedConfig:
    """Contacts between the two particle materials."""

    restitution: float | None = None  # null: the geometric mean of the two materials' own, as for the others
    friction: float | None = None
    rolling_friction: float | None = None


@dataclass
class RotationConfig:
    """Rotation about +y: piecewise linear between knots, constant after the last, at rest before the first."""

    times: list[float] = field(default_factory=lambda: [1.5])  # s
    speeds_rpm: list[float] = field(default_factory=lambda: [30.0])


@dataclass
class SceneConfig:
    """A scene: container, filling, material, gravity, schedule."""

    name: str = MISSING
    container: ContainerConfig | BoxConfig | HopperConfig = field(default_factory=ContainerConfig)  # by its kind
    filling: FillingConfig = field(default_factory=FillingConfig)
    material: MaterialConfig = field(default_factory=MaterialConfig)
    wall_material: MaterialConfig | None = None  # null: the particles' material, as is each key left out
    second_material: MaterialConfig | None = None  # of further spheres; what it leaves out is the first's
    mixed: MixedConfig = field(default_factory=MixedConfig)
    gravity: list[float] = field(default_factory=lambda: [0.0, 0.0, -9.81])  # m/s²
    rotation: RotationConfig = field(default_factory=RotationConfig)
    start_time: float = 1.5  # s, label of the settled state
    end_time: float = 5.5  # s
    frame_interval: float = 0.01  # s


@dataclass
class DemConfig:
    """The solver."""

    engine: str = "numba"  # numba | numpy
    time_step: float | None = None  # s; null: automatic, a stated fraction of min(Rayleigh time, contact time)
    skin: float | None = None  # m, Verlet skin; null: chosen by the clock; changes no bit of the result
    threads: int | None = None  # of the numba engine; null: chosen by the clock; changes no bit of the result
    precision: str = "float64"  # float64 | float32 (of contact forces, numba alone; positions stay float64)
    slip: str = "contact_point"  # contact_point | full_radius (as LAMMPS measures it): arms that spins add slip with
    allow_unsafe_step: bool = False  # true turns the error of a too large step into a recorded warning


@dataclass
class DatasetConfig:
    """Which cases are made, and which may be seen by training."""

    root: str = "data"  # folder of the HDF5 cases, relative to where the command runs
    training_speeds_rpm: list[float] = field(default_factory=lambda: [20.0, 25.0, 35.0, 40.0, 50.0, 60.0])
    validation_speeds_rpm: list[float] = field(default_factory=list)  # held out of training, used to choose
    holdout_speeds_rpm: list[float] = field(default_factory=lambda: [30.0])  # never read in training
    packing_seed: int = 0  # the filling shared by all cases
    unseen_packing_seed: int = 1  # the filling that only judging sees
    replicas: int = 5  # nudged runs of the held-out case for the noise floor
    workers: int = 2  # cases made at a time


@dataclass
class ContactModelConfig:
    """The contact network (DESIGN: a learned solver of contacts)."""

    name: str = "contact"
    iterations: int = 8
    hidden: int = 16
    channels: int = 4
    radius: float = 0.06  # m, reach of a pair
    wall_reach: float = 0.01  # m, gap up to which a wall contact is listed
    memory: bool = False  # carry a tangential spring vector of each contact from frame to frame
    velocity: str = "mean"  # mean | instantaneous: what the state's velocity is
    backend: str = "fused"  # fused (Numba, CPU) | torch


@dataclass
class CconvModelConfig:
    """A continuous-convolution network: lattice (the paper's CCNN) or radial kernel basis."""

    name: str = "ccnn"
    kernel: str = "lattice"  # lattice | radial
    kernel_size: int = 4  # lattice nodes along an edge of the cube
    width: int = 64
    layers: int = 3  # hidden layers of each branch
    radius: float = 0.1125  # m, support radius R
    constant_input: bool = True  # a constant 1 among the input features
    residual: bool = True  # where widths agree
    output_scale: float = 1.0e-3  # m per frame², one unit of the network's output
    update: str = "mean"  # mean | trapezoid
    backend: str = "fused"  # fused (Numba, CPU) | torch


# The schema that a model's name selects.
MODEL_SCHEMAS: dict[str, type] = {
    "contact": ContactModelConfig,
    "ccnn": CconvModelConfig,
    "radial": CconvModelConfig,
}


@dataclass
class BoundaryConfig:
    """How a model sees the walls: a convolution in one of three ways, the contact network in its own."""

    kind: str = "spheres"  # none | spheres | analytic | own (of the contact network)
    spacing: float = 0.5  # of wall spheres, in particle diameters
    normal: bool = True  # wall normals among the features
    velocity: bool = True  # wall velocities among the features


@dataclass
class LossConfig:
    """Weights of the terms; a term of weight 0 is not computed."""

    position_l2: float = 1.0
    position_mse: float = 0.0
    huber: float = 0.0
    velocity: float = 0.0
    acceleration: float = 0.0
    spin: float = 0.0
    overlap: float = 0.0
    momentum: float = 0.0
    cell_displacement: float = 0.0  # of the mean displacement in cells of the cross-section, 0.1 m wide
    center_of_mass: float = 0.0
    energy: float = 0.0
    speed_distribution: float = 0.0
    frame_weights: str = "uniform"  # uniform | discounted | inverse | rising
    spin_frame_weights: str = "uniform"  # of the spin term alone
    discount: float = 0.8  # γ of `discounted`


@dataclass
class RolloutConfig:
    """How far training looks ahead."""

    frames: int = 3  # F
    final_frames: int | None = None  # F from `final_from` of the budget on; null: F
    final_from: float = 0.6  # fraction of the steps
    growth: str = "jump"  # jump | linear: how F gets from `frames` to `final_frames`
    gradient_through_time: bool = True
    noise: float = 0.0  # m, Gaussian, on the first frame's position
    independent_noise: bool = False  # own noise on velocity × Δt and spin × r × Δt; false: the velocity implied
    mirror: bool = False  # random reflection along the drum's axis


@dataclass
class OptimConfig:
    """Adam and its learning rate."""

    learning_rate: float = 1.0e-4
    final_learning_rate: float = 2.0e-6
    schedule: str = "steps"  # steps | cosine | constant
    decay_steps: int = 8  # number of equal drops of `steps`
    warmup_steps: int = 0
    accumulate: int = 5  # windows whose gradients make one update
    gradient_clip: float | None = None  # norm; null: off
    weight_average: float = 0.0  # decay of the exponential weight average; 0: off


@dataclass
class TrainerConfig:
    """Budgets, checkpoints, validation."""

    budget: str = "steps"  # steps | time: what the schedule runs through, and what ends it
    steps: int = 1000  # optimiser updates, at most
    minutes: float | None = None  # across resumes; a cap, or with budget=time the budget; null: none
    checkpoint_every: float = 30.0  # s between checkpoints
    checkpoint_steps: int | None = None  # or every so many updates
    log_every: int = 20  # updates between logged losses
    startup_fraction: float = 0.0  # share of windows drawn from the first second of rotation
    startup_seconds: float = 1.0  # s


@dataclass
class JudgeConfig:
    """What is rolled out and judged after training."""

    speeds_rpm: list[float] = field(default_factory=lambda: [20.0, 25.0, 30.0, 35.0, 40.0])
    unseen_packing: bool = True
    short_horizon_starts: int = 20  # start frames of the 1, 3, 10 frame position errors
    gif: bool = True


@dataclass
class TrackingConfig:
    """Where runs are recorded."""

    experiment: str = "gran-bench"
    root: str = "results"  # folder of the database, the artifacts and the run folders
    folder: str | None = None  # name of this run in <root>/runs/, before its key; null: the recipe, what was changed
    sweep: str | None = None  # folder of a sweep in <root>/sweeps/; null: the recipe, what was changed
    parent: str | None = None  # id of the MLflow run that this one belongs to; a sweep sets it
    enabled: bool = True


@dataclass
class TrainConfig:
    """Everything that `python -m gran_bench.train` reads."""

    experiment: str = "default"  # first word of the run's folder and of its MLflow run
    seed: int = 0
    device: str = "auto"  # auto | cpu | cuda
    threads: int = 2  # CPU threads of the surrogate
    scene: SceneConfig = field(default_factory=SceneConfig)
    dem: DemConfig = field(default_factory=DemConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    model: ContactModelConfig | CconvModelConfig = field(default_factory=ContactModelConfig)  # by model.name
    boundary: BoundaryConfig = field(default_factory=lambda: BoundaryConfig(kind="own"))  # of the contact network
    loss: LossConfig = field(default_factory=LossConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)


@dataclass
class GenerateConfig:
    """Everything that `python -m gran_bench.generate` reads."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    dem: DemConfig = field(default_factory=DemConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)


@dataclass
class EvaluateConfig:
    """Everything that `python -m gran_bench.evaluate` reads; the scene is the one that the model was made for."""

    checkpoint: str = MISSING  # model file; `shipped`: the one in the package
    device: str = "auto"  # auto | cpu | cuda
    dem: DemConfig = field(default_factory=DemConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)


@dataclass
class ProfileConfig:
    """How thoroughly methods are compared."""

    name: str = "quick"  # of the folder of the results
    rounds: int = 5  # timed runs of every method, in turns
    judged_rounds: int = 5  # of these, from the first on, whose error is measured
    step_multiples: list[float] = field(default_factory=lambda: [0.5, 1.0, 2.0, 3.5, 5.0])  # of the automatic step
    single_multiples: list[float] = field(default_factory=lambda: [2.0])  # the same with float32 contact forces
    soft_moduli: list[float] = field(default_factory=lambda: [1.0e7, 1.0e6, 1.0e5])  # Pa, where softer than the scene
    soft_multiples: list[float] = field(default_factory=lambda: [1.0, 2.0])  # of a softened DEM's own automatic step
    numpy_frames: int = 2  # that the readable engine is timed over; 0: not at all
    stiffness: list[float] = field(default_factory=lambda: [1.0e7, 1.0e8, 1.0e9, 7.0e10])  # Pa; empty: no such study
    counts: list[int] = field(default_factory=lambda: [300, 1000, 3000, 6000])  # spheres; empty: no such study
    study_frames: int = 10  # of each run in these two studies
    study_rounds: int = 3  # of these two studies


@dataclass
class BenchmarkConfig(GenerateConfig):
    """Everything that `python -m gran_bench.benchmark` reads."""

    profile: ProfileConfig = field(default_factory=ProfileConfig)
    models: list[str] = field(default_factory=lambda: ["shipped"])  # model files; `shipped`: the one in the package
    seed: int = 0  # of the order in which methods take turns, and of the nudge that each round starts from
    measure: bool = True  # false: tables, figures and page anew from kept results, by today's rules
    root: str = "results/benchmark"  # folder of results and page, from where the command runs


@dataclass
class UiConfig:
    """Everything that `python -m gran_bench.ui` reads."""

    port: int = 5000  # of this machine
    tracking: TrackingConfig = field(default_factory=TrackingConfig)


@dataclass
class StressConfig:
    """Everything that `python -m gran_bench.stress` reads."""

    selection: str = "full"  # full | short
    cases: list[str] = field(default_factory=list)  # names of cases of that selection; empty: all
    case_list: str | None = None  # YAML file of cases; null: the list in the package
    checkpoint: str = "shipped"  # model file; `shipped`: the one in the package
    also: list[str] = field(default_factory=list)  # further model files
    workers: int = 2  # cases at a time
    patience: float = 900.0  # s that a case may take
    output: str = "results/stress"  # folder of the page
