"""The simulation as a LeRobot robot: what hardware hands over, under the same names, in real time.

Stock ``lerobot-record``, ``lerobot-teleoperate``, ``lerobot-replay`` and ``lerobot-rollout`` drive it. One
action is one control step, so an episode's frames follow from its seed and its actions alone, however busy
the machine was.
"""

import logging
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots.robot import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_vtrefine.datasets.features import (
    CAMERA,
    IMAGE_PREFIX,
    OBS_PREFIX,
    STATE_KEY,
    dataset_features,
    joint_keys,
    raw_to_frame,
)
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.envs.recording_note import add_episode, check_same, simulation_settings
from lerobot_vtrefine.extras import SIMULATOR, require
from lerobot_vtrefine.lerobot_compat import phases
from lerobot_vtrefine.lerobot_compat.arrays import ArraySpec
from lerobot_vtrefine.robots.config_vtrefine_sim import VtRefineSimConfig
from lerobot_vtrefine.robots.cut_commands import CutCommands
from lerobot_vtrefine.robots.extensions import extend_lerobot
from lerobot_vtrefine.robots.joint_targets import finite_targets
from lerobot_vtrefine.robots.simulated_pace import Pace
from lerobot_vtrefine.wording import plural

if TYPE_CHECKING:
    from lerobot_vtrefine.envs.live_world import LiveWorld

logger = logging.getLogger(__name__)

IMAGES = IMAGE_PREFIX.removeprefix(OBS_PREFIX)


class VtRefineSim(Robot):
    """Both arms, four pads and the depth camera of a simulated insertion.

    It bears the name of the robot that it stands for, so that its datasets and that robot's can be merged.
    """

    config_class = VtRefineSimConfig
    name = "vtrefine_sim"

    def __init__(self, config: VtRefineSimConfig) -> None:
        require("robot type vtrefine_sim", SIMULATOR)
        super().__init__(config)
        self.config = config
        self.env = config.simulation()
        self.body = get_embodiment(self.env.scene_config.embodiment)
        self.name = self.robot_type = self.body.robot_type
        self.cameras = {CAMERA: None}  # LeRobot counts them, for its image writer
        extend_lerobot({pad: PadConfig("simulation") for pad in self.body.pad_names})
        phases.install()
        phases.watch_replay(self)
        self._world: LiveWorld | None = None
        self._pace = Pace(1.0 / config.fps)
        self._cuts = CutCommands(self.body, "the joints' limits and rates")
        self._viewer: Any = None
        self._in_phase = False
        self._events: dict[str, bool] | None = None
        """LeRobot's keys, while an episode is recorded."""
        self.on_restart: Callable[[], None] | None = None
        """Called when the next episode has begun without LeRobot's doing, and when commands move it."""
        self._recorded: tuple[Any, int, dict[str, Any]] | None = None
        """Dataset, index and row of the last recorded episode, until it is known whether it was saved."""

    @property
    def world(self) -> "LiveWorld":
        """The running simulation; raises RuntimeError before `connect`."""
        if self._world is None:
            raise RuntimeError("the simulation runs once the robot is connected")
        return self._world

    # --- features -----------------------------------------------------------------------------------

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Joints, depth, colour if it is on, raw and idle pad counts, their age, the camera's model."""
        features = dataset_features(*self.env.camera_size, self.body, self.env.colour_size, self.env.limited)
        found: dict[str, Any] = dict(self.action_features)
        for key, feature in features.items():
            if not key.startswith(OBS_PREFIX) or key == STATE_KEY:
                continue
            name, shape = key.removeprefix(OBS_PREFIX).removeprefix(IMAGES), tuple(feature["shape"])
            is_image = feature["dtype"] in ("image", "video")
            found[name] = shape if is_image else ArraySpec(shape, feature["dtype"], feature.get("info"))
        return found

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """Absolute joint targets in the embodiment's order [rad, m]."""
        return dict.fromkeys(joint_keys(self.body), float)

    # --- connection ---------------------------------------------------------------------------------

    @property
    def is_connected(self) -> bool:
        """Whether the simulation runs."""
        return self._world is not None

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Build the simulation and start the first episode."""
        from lerobot_vtrefine.envs.live_world import LiveWorld

        self._world = LiveWorld(self.env)
        self._start(self.config.seed)
        if self.config.view == "browser":
            from lerobot_vtrefine.view.browser import BrowserView

            self._viewer = BrowserView(self.world, self.config.view_port)
        logger.info("%s is simulated: %s, %d Hz", self.name, self.env.scene_config.pair, self.config.fps)

    def configure(self) -> None:
        """Nothing to configure."""

    @property
    def is_calibrated(self) -> bool:
        """Always: encoders and pads of the simulation read what is there."""
        return True

    def calibrate(self) -> None:
        """Nothing to calibrate."""

    def disconnect(self) -> None:
        """End the simulation, and note the outcome of the last episode if it was saved."""
        self._note_outcome()
        self._tell_pace()
        if told := self._cuts.describe():
            logger.warning("%s", told)
        if self._viewer is not None:
            self._viewer.close()
        self._world = self._viewer = None

    # --- observation and action ---------------------------------------------------------------------

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """What the hardware's sensors would give at this moment."""
        began = time.perf_counter()
        frame = raw_to_frame(self.world.observe(), self.body)
        values: RobotObservation = dict(
            zip(self.action_features, map(float, frame.pop(STATE_KEY)), strict=True)
        )
        values |= {key.removeprefix(OBS_PREFIX).removeprefix(IMAGES): value for key, value in frame.items()}
        self._observing_s = time.perf_counter() - began
        return values

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """One control step with absolute joint targets, cut to the joints' limits and rates.

        Returns:
            The targets that the servos hold at the end of the step.

        Raises:
            ValueError: a target is not a number; nothing is sent.
        """
        began = time.perf_counter()
        # As datasets keep them: an episode that is replayed is then the same.
        wanted = finite_targets(action, self.action_features).astype(np.float32)
        waits = self._waiting_steps > 0
        if not waits:
            self.world.step(wanted)
            self._cuts.count(wanted, self.world.sim.command_targets()[0])
        if self._viewer is not None:
            self._viewer.update()
        self._pace.step_done(time.perf_counter() - began + self._observing_s)
        if waits:
            self._wait()
        else:
            self._end_or_go_on()
        return self.held_targets()

    def held_targets(self) -> RobotAction:
        """The targets that the servos hold now: hands that grip something are told to close farther."""
        targets = self.world.sim.command_targets()[0]
        return dict(zip(self.action_features, map(float, targets), strict=True))

    # --- episodes -----------------------------------------------------------------------------------

    def check_rate(self, fps: float) -> None:
        """Raises: ValueError where a command gives another number of actions a second than are simulated."""
        if fps != self.config.fps:
            raise ValueError(
                f"--robot.fps={self.config.fps}, but this command gives {fps:g} actions a second, by its"
                f" --fps or --dataset.fps or as it was recorded: give --robot.fps={fps:g} or change the other"
            )

    @contextmanager
    def phase(self, events: dict[str, bool], dataset: Any | None) -> Generator[None]:
        """LeRobot records an episode, or waits between two: see `lerobot_compat.phases`.

        Raises:
            ValueError: the dataset is of another simulation.
        """
        if dataset is not None:
            self._note_outcome()  # LeRobot saves an episode after the wait that follows it
            check_same(Path(dataset.root), simulation_settings(self.env))
            self._start(self.config.seed + dataset.num_episodes)
        elif not events.get("rerecord_episode"):
            self._start(self.world.seed + 1)
        self._in_phase, self._events = True, events if dataset is not None else None
        try:
            yield
        finally:
            self._in_phase, self._events = False, None
            if dataset is not None:
                self._recorded = dataset, dataset.num_episodes, self.world.row()
                logger.info("episode %d: %s", dataset.num_episodes, describe(self.world.row()))
                if self.world.outcome and self.config.end_episodes:
                    events["exit_early"] = False  # ours, where LeRobot's own time ended the loop first
            self._tell_pace()

    def _start(self, seed: int) -> None:
        self._observing_s = 0.0
        self._ended_s: float | None = None
        self._waiting_steps = 0
        self.world.reset(seed)
        self._pace.restart()

    def _end_or_go_on(self) -> None:
        """At an episode's outcome: end its recording; without recording start the next one after a pause."""
        if not self.world.outcome:
            return
        if self._events is not None:
            self._events["exit_early"] |= self.config.end_episodes
        if self._in_phase:
            return
        if self._ended_s is None:
            self._ended_s = self.world.time_s
            logger.info("seed %d: %s", self.world.seed, describe(self.world.row()))
        elif self.world.time_s - self._ended_s >= self.config.pause_s / 2:
            self._start(self.world.seed + 1)
            # Half of the pause shows the end, half the new start: a policy that decides for several steps at
            # once and is not told of episodes, as in lerobot-rollout, uses up what the old one called for.
            self._waiting_steps = round(self.config.pause_s / 2 * self.config.fps)
            self._tell_restart()

    def _wait(self) -> None:
        self._waiting_steps -= 1
        if self._waiting_steps == 0:
            self._pace.restart()
            self._tell_restart()

    def _tell_restart(self) -> None:
        if self.on_restart is not None:
            self.on_restart()

    def _note_outcome(self) -> None:
        """Note the last recorded episode beside its dataset, unless it was discarded."""
        if self._recorded is not None:
            dataset, index, row = self._recorded
            self._recorded = None
            if dataset.num_episodes > index:
                add_episode(Path(dataset.root), simulation_settings(self.env), index, row)

    def _tell_pace(self) -> None:
        if told := self._pace.describe():
            logger.info("%s", told)
        self._pace.restart()


def describe(row: dict[str, Any]) -> str:
    """An episode's outcome in a few words."""
    if row["success"] and row["failure"] == "none":
        return f"success after {row['time_to_success_s']:.1f} s (seed {row['seed']})"
    steps = plural(row["steps"], "step")
    return f"no success, {row['failure'].replace('_', ' ')} after {steps} (seed {row['seed']})"
