"""Every setting of the simulation, as frozen dataclasses; imports no simulator."""

import re
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.embodiments import DEFAULT_BODY
from lerobot_vtrefine.embodiments.camera_config import CameraConfig
from lerobot_vtrefine.embodiments.embodiment import STARTS
from lerobot_vtrefine.sim.depth_sensors import DEPTH_SENSORS
from lerobot_vtrefine.sim.setting_checks import check_numbers

PROCEDURAL_PAIRS = ("round", "square", "hexagon", "d_shape", "cross", "key")
MESH_PAIR_PREFIX = "automate/"
MAX_TABLE_HEIGHT_M = 0.2
SOCKETS = ("held", "stands")
BACKENDS = ("single", "batch", "warp")
WARP_SOLVERS = ("own", "stock")
IDEAL_NOISE_LEVEL = 3.0
CONTROL_HZ = (1, 100)
"""Slowest and fastest control rate: command rates, servo model and grasp are tried in between."""
EPISODE_S = {"table": 24.0, "grasped": 4.8}
"""Time-out by start, where no number of control steps is given."""


@dataclass(frozen=True)
class SceneConfig:
    """What stands in the scene and how it is simulated."""

    pair: str = "round"
    """Procedural pair, or automate/ID for meshes from `mesh_dir`."""
    clearance_m: float = 0.002
    """Diametral clearance of procedural pairs; mesh pairs have their own."""
    negative_control_m: float = 0.0
    """Above 0 the hole is this much *smaller* than the plug (diametral): a check that must never succeed."""
    start: str = "table"
    """table: both parts stand on the table. grasped: both are in hand."""
    socket: str = "held"
    """held: a hand lifts the socket, and the plug goes in in air. stands: the socket stays on the table."""
    embodiment: str = DEFAULT_BODY
    """The robot, see `embodiments`."""
    table_height_m: float = 0.0
    """Height of the table's top in the world, in which the arms' bases have fixed places. A lab's arms may
    stand higher or lower beside their table: `vtrefine-replay` estimates it from recorded episodes."""
    mesh_dir: Path | None = None
    """Folder with {ID}_plug.obj and {ID}_socket.obj, for automate/ID."""
    mesh_scale: str = "flexitac"
    """flexitac (that setup's factors for its five pairs, 1 for any other), unit, or one factor for both
    parts."""
    timestep_s: float = 0.0025
    """Longest physics step. What is rigid stays as stiff in any, see `sim.rigid`. Where control steps are no
    whole number of these, --env.fps shortens it."""
    camera: CameraConfig | None = None
    """By default the body's camera for `start`."""
    depth_sensor: str = "ideal"
    """What the camera makes of true depths: ideal (whole millimetres of them), or d405 or d435, with the
    noise, edges and gaps of these stereo cameras."""
    servo_gain_scale: float = 1.0
    """Factor on the arms' servo stiffness; damping follows with its square root."""
    gravity_compensation: bool = True
    """The arms' servos carry the arms' own weight, as integral action does on the real ones."""
    pad_friction: float = 1.0
    """Coefficient of sliding friction of pads against parts."""
    part_friction: float = 0.3
    """The same of plug against socket and of both against the table."""
    part_density: float = 1000.0
    """[kg/m^3]; parts never weigh less than 40 g, below which contacts turn soft."""
    pad_time_constant_s: float = 0.01
    """Contact time constant of the pads: about 0.6 mm compression at 20 N."""
    rigid_time_constant_s: float = 0.005
    """Contact time constant of what is rigid, parts and couplings of fingers: parts press about 0.3 mm into
    each other at 6 N. At clearances of 1 mm and below use 0.004 or less."""

    def __post_init__(self) -> None:
        check_choice("start", self.start, STARTS)
        check_choice("socket", self.socket, SOCKETS)
        check_choice("depth_sensor", self.depth_sensor, DEPTH_SENSORS)
        if self.socket == "stands" and self.start != "table":
            raise ValueError(f"socket=stands needs start=table, not start={self.start}")
        if not 0.0 < self.timestep_s <= 0.005:
            raise ValueError(f"timestep_s must lie in (0, 0.005] s, got {self.timestep_s}")
        if not self.clearance_m > 0.0:
            raise ValueError(f"clearance_m must be above 0, got {self.clearance_m}")
        if not abs(self.table_height_m) <= MAX_TABLE_HEIGHT_M:
            raise ValueError(
                f"table_height_m must lie within -{MAX_TABLE_HEIGHT_M} .. {MAX_TABLE_HEIGHT_M} m,"
                f" got {self.table_height_m}"
            )
        positive = (
            "servo_gain_scale",
            "pad_friction",
            "part_friction",
            "part_density",
            "pad_time_constant_s",
            "rigid_time_constant_s",
        )
        check_numbers(self, above_0=positive, not_below_0=("negative_control_m",))

    @property
    def noise_level(self) -> float:
        """Standard deviation of the depth noise that training adds to simulated clouds, in the paper's unit:
        none where the image has a sensor's own.
        """
        return IDEAL_NOISE_LEVEL if DEPTH_SENSORS[self.depth_sensor] is None else 0.0

    @property
    def hole_clearance_m(self) -> float:
        """Diametral clearance of the hole as built: negative in the negative control."""
        return -self.negative_control_m if self.negative_control_m else self.clearance_m


@dataclass(frozen=True)
class TableStart:
    """Where the parts stand when an episode starts on the table."""

    socket_centre_m: tuple[float, float] = (0.0, -0.06)
    """Middle of the square in which the socket's axis lies, in the world's x and y."""
    plug_centre_m: tuple[float, float] = (0.0, 0.065)
    """The same of the plug's."""
    square_m: float = 0.03
    """Side of both squares."""
    yaw_rad: float = 0.15
    """Half range of each part's yaw."""

    def __post_init__(self) -> None:
        check_numbers(self, "table.", not_below_0=("square_m", "yaw_rad"))


@dataclass(frozen=True)
class GraspedStart:
    """How hands and parts stand when an episode starts in hand. Half ranges of uniform distributions."""

    mouth_m: tuple[float, float, float] = (0.0, 0.0, 0.14)
    """Nominal place of the socket's mouth."""
    plug_height_m: float = 0.017
    """Nominal height of the plug's tip above the mouth."""
    hand_xy_m: float = 0.004
    """Each hand's displacement from its nominal place, in x and in y."""
    hand_z_m: float = 0.002
    """The same in height."""
    hand_yaw_rad: float = 0.03
    """Each hand's rotation about the vertical."""
    slip_m: float = 0.002
    """In-hand offset of each part along both axes of the pads."""
    slip_z_m: float | None = None
    """In-hand offset across the fingers, where it differs from the one along them (``slip_m``): the hand's
    height at a part that stood on a table is known better than how far the hand reached."""
    slip_rad: float = 0.052
    """In-hand rotation of each part about the pads' normal."""
    left_pitch_rad: float = 0.45
    """How far the left hand points down."""
    right_pitch_rad: float = 0.2
    """How far the right hand points down; with 0.45 even a perfect expert loses one insertion in six."""
    squeeze_m: float = 0.010
    """Grippers' commands close by this much more than the part's width, per finger: about 20 N per pad."""
    settle_s: float = 0.25
    """Simulated before the episode begins, so that grasps come to rest."""

    def __post_init__(self) -> None:
        ranges = ("hand_xy_m", "hand_z_m", "hand_yaw_rad", "slip_m", "slip_z_m", "slip_rad")
        check_numbers(self, "grasped.", above_0=("settle_s",), not_below_0=ranges)

    @property
    def slip_xz_m(self) -> tuple[float, float]:
        """In-hand offsets along the fingers and across them."""
        return self.slip_m, self.slip_m if self.slip_z_m is None else self.slip_z_m


@dataclass(frozen=True)
class SuccessConfig:
    """When the plug counts as inserted."""

    depth_slack_m: float = 0.002
    """How far the plug may be short of fully seated."""
    lateral_m: float = 0.004
    """Largest distance of the plug's origin from the socket's axis."""
    tilt_rad: float = 0.2007
    """Largest angle between both axes."""
    mouth_height_m: float = 0.07
    """The mouth must be at least this high above the table: inserted in air."""
    hold_s: float = 1.0
    """It must stay so for that long."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            "success.",
            above_0=("lateral_m", "tilt_rad"),
            not_below_0=("hold_s",),
            may_be_infinite=("mouth_height_m",),  # -inf where the socket stands on the table
        )

    def hold_steps(self, control_dt_s: float) -> int:
        """Consecutive observations that must find the plug seated: n steps apart lie n + 1 observations."""
        return round(self.hold_s / control_dt_s) + 1


@dataclass(frozen=True)
class LimitsConfig:
    """What ends an episode in failure; ``inf`` switches a limit off."""

    in_hand_shift_m: float = 0.005
    """Largest movement of a part in its hand since the grasp."""
    contact_force_n: float = 20.0
    """Largest force between plug and socket, averaged over `force_window_s`: the clean expert stays below
    2 N, demonstrations that land on the rim below 8 N, and pushing on reaches 30 N."""
    force_window_s: float = 0.01
    """A single physics step that is hit harder is no failure."""
    drop_s: float = 0.3
    """A lifted part that its hand has not held for this long counts as dropped."""

    def __post_init__(self) -> None:
        limits = ("in_hand_shift_m", "contact_force_n", "drop_s")
        check_numbers(self, "limits.", above_0=(*limits, "force_window_s"), may_be_infinite=limits)


@dataclass(frozen=True)
class TaskConfig:
    """Control, start, success, limits and length of an episode."""

    control_hz: float = 10.0
    """Control steps a second."""
    episode_steps: int | None = None
    """Control steps until the time-out; by default 24 s from the table, 4.8 s in hand."""
    joint_rate: float = 1.0
    """Largest commanded speed of a revolute joint [rad/s]."""
    finger_rate: float = 0.15
    """Largest commanded speed of a finger [m/s]."""
    table: TableStart = field(default_factory=TableStart)
    grasped: GraspedStart = field(default_factory=GraspedStart)
    success: SuccessConfig = field(default_factory=SuccessConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)

    def __post_init__(self) -> None:
        check_control_rate("control_hz", self.control_hz)
        if self.episode_steps is not None and (self.episode_steps < 1 or self.episode_steps % 1):
            raise ValueError(f"episode_steps must be a whole number from 1 on, got {self.episode_steps}")
        rates = ("joint_rate", "finger_rate")
        check_numbers(self, above_0=rates, may_be_infinite=rates)

    @property
    def control_dt_s(self) -> float:
        """Length of a control step."""
        return 1.0 / self.control_hz

    def steps_of(self, start: str) -> int:
        """Control steps of an episode from this start."""
        return self.episode_steps or round(EPISODE_S[start] * self.control_hz)


@dataclass(frozen=True)
class ShearConfig:
    """Tangential force per taxel, a channel of its own: FlexiTac measures pressure only, so no policy of this
    package reads it. Its friction is the scene's `pad_friction`, or what randomisation made of it.
    """

    on: bool = False
    """Simulate it."""
    stiffness_n_per_m: float = 400.0
    """Tangential stiffness of the skin under one taxel."""

    def __post_init__(self) -> None:
        check_numbers(self, "shear.", above_0=("stiffness_n_per_m",))


@dataclass(frozen=True)
class WarpConfig:
    """The warp backend: where it runs, and the fixed room that it sets aside; an episode that
    finds too little of it ends as a failure.
    """

    device: str = "auto"
    """auto (a CUDA GPU where there is one), cpu, cuda or cuda:i."""
    contacts_per_world: int = 96
    """Contacts, and pairs of geoms close to each other, on average over the worlds."""
    convex_per_world: int = 32
    """Contacts for the general collision of convex shapes (parts of meshes, cylinders in their holes), on
    average over the worlds: each takes 8 kB, most of what a world needs. A few worlds have more of both."""
    rows_per_world: int = 384
    """Rows of constraints in any one world: 4 per contact, of which a round plug on the rim makes 84."""
    solver: str = "own"
    """own (this package's order of kernels and constraint solver), or stock (mujoco_warp's own step)."""
    graph: bool = True
    """Record a substep as a graph, where the device and its driver can."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", self.device):
            raise ValueError(f"warp.device must be auto, cpu, cuda or cuda:0, not {self.device!r}")
        if self.solver not in WARP_SOLVERS:
            raise ValueError(f"warp.solver must be {' or '.join(WARP_SOLVERS)}, not {self.solver!r}")
        for name in ("contacts_per_world", "convex_per_world", "rows_per_world"):
            if getattr(self, name) < 1:
                raise ValueError(f"warp.{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class RandomizationConfig:
    """Differences between worlds, drawn anew at every reset from the episode's seed; off by default.

    Ranges are (lowest, highest); None keeps the nominal value.
    """

    clearance_m: tuple[float, float] | None = None
    """Diametral clearance of procedural pairs."""
    pad_friction: tuple[float, float] | None = None
    """See `SceneConfig.pad_friction`."""
    part_friction: tuple[float, float] | None = None
    """See `SceneConfig.part_friction`."""
    part_mass_scale: tuple[float, float] | None = None
    """Factor on both parts' masses and inertias."""
    pad_stiffness_scale: tuple[float, float] | None = None
    """Factor on the pads' stiffness, in the contact and in the sensor model alike."""
    sensor_gain_scale: tuple[float, float] | None = None
    """Factor on what the pads read of a force."""
    contact_force_n: tuple[float, float] | None = None
    """The limit on force (`LimitsConfig.contact_force_n`). It is no secret: policy, critic and expert are
    told."""
    camera_position_m: float = 0.0
    """Half range of the camera's displacement along each axis."""
    camera_rotation_rad: float = 0.0
    """Half range of its rotation about each of its axes."""

    def __post_init__(self) -> None:
        for name in (*RANGES, "contact_force_n"):
            bounds = getattr(self, name)
            if bounds is not None and not 0.0 < bounds[0] <= bounds[1]:
                raise ValueError(f"randomization.{name} needs 0 < lowest <= highest, got {bounds}")
        check_numbers(self, "randomization.", not_below_0=("camera_position_m", "camera_rotation_rad"))


RANGES = (
    "clearance_m",
    "pad_friction",
    "part_friction",
    "part_mass_scale",
    "pad_stiffness_scale",
    "sensor_gain_scale",
)


def check_control_rate(name: str, rate_hz: float) -> None:
    """Raises: ValueError for a control rate [Hz] outside of `CONTROL_HZ`."""
    slowest, fastest = CONTROL_HZ
    if not slowest <= rate_hz <= fastest:
        raise ValueError(
            f"{name} must lie between {slowest} and {fastest} control steps a second, got {rate_hz:g}"
        )


def fitting_timestep(longest_s: float, control_hz: float) -> float:
    """The longest physics step up to `longest_s` [s] of which a control step is a whole number."""
    steps = 1.0 / (control_hz * longest_s)
    return longest_s if abs(steps - round(steps)) < 1e-6 else 1.0 / (control_hz * (int(steps) + 1))
