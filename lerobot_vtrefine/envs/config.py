"""LeRobot environment type ``vtrefine``: everything that ``--env.*`` can set. Imports no simulator."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.datasets.features import (
    ACTION_KEY,
    LIMITS_KEY,
    OBS_PREFIX,
    RGB_KEY,
    env_key_map,
    env_observation_shapes,
)
from lerobot_vtrefine.embodiments import Embodiment, get_embodiment
from lerobot_vtrefine.extras import SIMULATOR, require
from lerobot_vtrefine.lerobot_compat import config_errors
from lerobot_vtrefine.lerobot_compat.config_errors import told_by_lerobot
from lerobot_vtrefine.sim.config import (
    BACKENDS,
    RandomizationConfig,
    SceneConfig,
    ShearConfig,
    TaskConfig,
    WarpConfig,
    check_control_rate,
    fitting_timestep,
)
from lerobot_vtrefine.sim.reality import Reality, load_reality

VECTORIZATIONS = ("native", "gym")
ABLATIONS = ("none", "touch", "touch_shuffled", "touch_other", "vision")
RENDERER = "mujoco_warp"
SMALLEST_PX = 16
"""Height and width that video encoders take."""
SHORTCUTS = ("pair", "clearance_m", "start", "mesh_dir")
"""Fields of ``scene`` that have a flag of their own."""

config_errors.install()


class EnvAction(PolicyFeature):
    """An environment's action, which tells policies whose joints it moves and how often; not saved."""

    fps: int
    body: str

    @classmethod
    def of(cls, body: Embodiment, fps: int) -> "EnvAction":
        """Targets of all joints of a body, ``fps`` of them a second."""
        action = cls(type=FeatureType.ACTION, shape=(body.num_joints,))
        action.fps, action.body = fps, body.name
        return action


@EnvConfig.register_subclass("vtrefine")
@dataclass
class VtRefineEnvConfig(EnvConfig):
    """Bimanual insertion with tactile pads and a depth camera, simulated in MuJoCo.

    ``pair``, ``clearance_m``, ``start``, ``mesh_dir`` and ``episode_steps`` are short for the fields of
    ``scene`` and ``rules`` with these names, and win over them.
    """

    task: str | None = "insert the plug into the socket"
    """Natural-language task: stored in datasets, shown to policies."""
    fps: int = int(TaskConfig.control_hz)
    """Control steps, and so observations and actions, per second: 1 to 100."""
    pair: str | None = None
    """round, square, hexagon, d_shape, cross, key or automate/ID."""
    clearance_m: float | None = None
    """Diametral clearance of procedural pairs [m]."""
    start: str | None = None
    """table (both parts stand on the table) or grasped (both are in hand)."""
    start_bank: Path | None = None
    """File of vtrefine-record-starts: episodes start where it has both parts in the hands, with the time that
    is left from the table."""
    mesh_dir: Path | None = None
    """Folder of meshes for automate/ID."""
    episode_steps: int | None = None
    """Control steps until the time-out."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    """What stands in the scene: camera, frictions, servo gains, time step."""
    rules: TaskConfig = field(default_factory=TaskConfig)
    """Start ranges, success, limits on force and in-hand shift, command rates."""
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    """Ranges of what differs between episodes."""
    sensor_model: str = "default"
    """default, paper, or the path of a sensor_model.json."""
    shear: ShearConfig = field(default_factory=ShearConfig)
    """Tangential force per taxel, as ``info["shear"]``: off unless ``--env.shear.on=true``."""
    reality: Path | None = None
    """JSON file of hidden physics: the environment then stands in for reality; its format:
    vtrefine-diagnose --help_format=reality.json."""
    backend: str = "batch"
    """single, batch (threads) or warp."""
    num_threads: int = 0
    """Threads of the batch backend; 0 uses all cores."""
    warp: WarpConfig = field(default_factory=WarpConfig)
    """Device and buffers of the warp backend."""
    vectorization: str = "native"
    """native: one batched simulation. gym: one per environment, sync or async by --eval.use_async_envs."""
    ablate: str = "none"
    """none; touch or vision: replaced by its mean over ``ablate_dataset``; touch_other: touch of another
    episode, out of ``ablate_dataset``; touch_shuffled: touch of the same episode, out of order."""
    ablate_dataset: Path | None = None
    """Root of the LeRobot dataset whose mean frame, or touch, the ablation shows."""
    rgb: bool = False
    """Colour images of the camera's view too, as policies without a depth camera want them."""
    rgb_size: tuple[int, int] = (120, 160)
    """Height and width of the colour images in pixels."""
    video_episodes: int = 10
    """Episodes that ``lerobot-eval`` makes videos of: the first ones, at most its ten; 0 draws nothing."""
    menagerie_dir: Path | None = None
    """Folder of MuJoCo Menagerie: videos and the live view then show the arms by its meshes. What is
    simulated, touched and observed stays the same."""
    metrics_path: Path | None = None
    """JSON-lines file; every finished episode appends seed, success, in-hand shift, peak force, ..."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    """Unused as a flag: follows from the camera's size."""
    features_map: dict[str, str] = field(default_factory=dict)
    """Unused as a flag: LeRobot's names of the observations."""

    @told_by_lerobot
    def __post_init__(self) -> None:
        require("--env.type=vtrefine", SIMULATOR)  # now, rather than when training first evaluates
        check_choice("--env.vectorization", self.vectorization, VECTORIZATIONS)
        check_choice("--env.ablate", self.ablate, ABLATIONS)
        check_choice("--env.backend", self.backend, BACKENDS)
        check_control_rate("--env.fps", self.fps)
        for name in ("num_threads", "video_episodes"):
            if getattr(self, name) < 0:
                raise ValueError(f"--env.{name} must be at least 0, got {getattr(self, name)}")
        if self.ablate not in ("none", "touch_shuffled") and self.ablate_dataset is None:
            raise ValueError(
                f"--env.ablate={self.ablate} needs --env.ablate_dataset, the policy's training data"
            )
        if self.rules.control_hz != TaskConfig.control_hz:
            raise ValueError("set the control rate with --env.fps, not with --env.rules.control_hz")
        if self.hidden.sensor_model is not None and self.sensor_model != "default":
            raise ValueError(
                f"{self.reality} holds a sensor model: drop --env.sensor_model={self.sensor_model}"
            )
        if self.rgb:
            require("--env.rgb=true", (*SIMULATOR, RENDERER))
            if min(self.rgb_size) < SMALLEST_PX:
                raise ValueError(f"--env.rgb_size must be at least {SMALLEST_PX} pixels, got {self.rgb_size}")
            if self.ablate == "vision":
                raise ValueError("--env.ablate=vision hides the depth image only: leave out --env.rgb=true")
        self.features = self._policy_features()
        self.features_map = env_key_map(self.body, colour=self.rgb, limited=self.limited)
        _ = self.task_config  # its own checks, now rather than in a worker process

    @property
    def scene_config(self) -> SceneConfig:
        """The scene with the shortcuts and a physics step that fits the control rate, as it really is."""
        given = {name: getattr(self, name) for name in SHORTCUTS if getattr(self, name) is not None}
        given["timestep_s"] = fitting_timestep(self.scene.timestep_s, self.fps)
        return self.hidden.applied(replace(self.scene, **given))

    @property
    def body(self) -> Embodiment:
        """The robot in the scene.

        Raises:
            ValueError: ``scene.embodiment`` is unknown.
        """
        return get_embodiment(self.scene.embodiment)

    @property
    def hidden(self) -> Reality:
        """What differs from the simulation that everybody knows: nothing without ``reality``.

        Raises: ValueError for a file that is none, or not there.
        """
        if self.reality is None:
            return Reality()
        if not Path(self.reality).exists():
            raise ValueError(
                f"--env.reality={self.reality}: no such file; vtrefine-diagnose --help_format=reality.json"
                " tells what it holds"
            )
        return load_reality(self.reality)

    @property
    def task_config(self) -> TaskConfig:
        """The rules at this control rate and episode length."""
        steps = self.episode_steps if self.episode_steps is not None else self.rules.episode_steps
        return replace(self.rules, control_hz=float(self.fps), episode_steps=steps)

    @property
    def camera_size(self) -> tuple[int, int]:
        """Height and width of the depth image in pixels."""
        scene = self.scene_config
        camera = scene.camera or self.body.cameras[scene.start]
        return camera.height, camera.width

    @property
    def colour_size(self) -> tuple[int, int] | None:
        """Height and width of the colour image in pixels; None where there is none."""
        return self.rgb_size if self.rgb else None

    @property
    def limited(self) -> bool:
        """Whether every episode has a limit on force of its own; observations then hold the limits."""
        return self.randomization.contact_force_n is not None

    @property
    def max_episode_steps(self) -> int:
        """Control steps until the time-out."""
        return self.task_config.steps_of(self.scene_config.start)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Unused: environments are built by ``create_envs``."""
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, Any]]:
        """LeRobot's factory: ``{"vtrefine": {0: vector environment}}``."""
        from lerobot_vtrefine.envs.vectorization import make_vector_env

        return {self.type: {0: make_vector_env(self, n_envs, use_async_envs)}}

    def _policy_features(self) -> dict[str, PolicyFeature]:
        """LeRobot features under environment keys.

        Depth is not a VISUAL feature here: ``lerobot-eval --eval.recording=true`` makes videos of these, and
        millimetres do not fit into one.
        """
        shapes = env_observation_shapes(*self.camera_size, self.body, self.limited)
        kinds = {LIMITS_KEY.removeprefix(OBS_PREFIX): FeatureType.ENV}
        features = {
            key: PolicyFeature(type=kinds.get(key, FeatureType.STATE), shape=shape)
            for key, (shape, _) in shapes.items()
        }
        if self.colour_size is not None:
            features[RGB_KEY] = PolicyFeature(type=FeatureType.VISUAL, shape=(*self.colour_size, 3))
        return {ACTION_KEY: EnvAction.of(self.body, self.fps), **features}


def checked_env(env: EnvConfig) -> VtRefineEnvConfig:
    """The environment, if it is this package's. Raises: ValueError for another type."""
    if not isinstance(env, VtRefineEnvConfig):
        raise ValueError(f"this command needs --env.type=vtrefine, got {env.type}")
    return env
