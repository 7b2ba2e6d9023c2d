"""Bimanual insertion in many worlds: reset by seed, step by joint targets, observe raw sensor data.

Shapes: N worlds, m of them addressed by sorted ids; J joints; H x W depth pixels; P pads of T taxels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch

from lerobot_vtrefine.cores import usable_cores
from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.sim import starts, task
from lerobot_vtrefine.sim.backends import Trace, get_backend
from lerobot_vtrefine.sim.config import (
    RANGES,
    RandomizationConfig,
    SceneConfig,
    ShearConfig,
    TaskConfig,
    WarpConfig,
)
from lerobot_vtrefine.sim.depth import DepthCamera
from lerobot_vtrefine.sim.depth_sensors import DEPTH_SENSORS
from lerobot_vtrefine.sim.drive import make_drive
from lerobot_vtrefine.sim.episode import EpisodeState, Measured, in_hand, update
from lerobot_vtrefine.sim.host import start_copy, to_host, without_torch_threads
from lerobot_vtrefine.sim.pads import Pads
from lerobot_vtrefine.sim.privileged import Privileged, describe
from lerobot_vtrefine.sim.randomization import Randomizer, WorldParameters
from lerobot_vtrefine.sim.reality import RobotFaults
from lerobot_vtrefine.sim.scene import Scene, build_scene
from lerobot_vtrefine.sim.settling import Settler
from lerobot_vtrefine.sim.state_cache import StateCache
from lerobot_vtrefine.sim.substeps import count_substeps, start_summary
from lerobot_vtrefine.sim.task import FAILURES
from lerobot_vtrefine.sim.touch import Touch, touch_source
from lerobot_vtrefine.tactile import SensorModel

__all__ = ["FAILURES", "InsertionSim", "StepResult"]

Array = np.ndarray


@dataclass(frozen=True)
class StepResult:
    """Outcome of one control step, (m,) each."""

    reward: Array
    """1 in the step in which success is reached, else 0."""
    terminated: Array
    truncated: Array
    success: Array


class InsertionSim:
    """N independent worlds of one scene.

    Args:
        scene_config: what stands in the scene.
        task_config: control, start, success, limits.
        sensor: "default", "paper", the path of a sensor_model.json, or a model.
        num_envs: N.
        backend: "single", "batch" or "warp".
        num_threads: of the batch backend; 0 uses all cores.
        randomization: differences between worlds.
        warp: device and buffers of the warp backend.
        robot_faults: what the arms do that commands and readings do not tell.
        shear: whether `shear` gives tangential forces, and the skin that they strain.

    Raises: ValueError for settings that make no sense, FileNotFoundError without meshes or sensor model.
    """

    def __init__(
        self,
        scene_config: SceneConfig | None = None,
        task_config: TaskConfig | None = None,
        sensor: str | SensorModel = "default",
        num_envs: int = 1,
        backend: str = "batch",
        num_threads: int = 0,
        randomization: RandomizationConfig | None = None,
        warp: WarpConfig | None = None,
        robot_faults: RobotFaults | None = None,
        shear: ShearConfig | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        self.scene: Scene = build_scene(scene_config or SceneConfig())
        self.config = task.rules_in(self.scene.config, task_config or TaskConfig())
        self.num_envs = num_envs
        self.noise_level = self.scene.config.noise_level
        self.substeps = count_substeps(self.scene.config.timestep_s, self.config)
        """Physics steps per control step."""
        self._backend = get_backend(backend, self.scene.model, num_envs, num_threads, warp)
        self._touch = touch_source(self.scene, self._backend)
        self._randomizer = Randomizer(self.scene, randomization or RandomizationConfig())
        model = SensorModel.named(sensor) if isinstance(sensor, str) else sensor
        device = self._backend.device
        threads = (num_threads or usable_cores()) if backend == "batch" else 1
        self._pads = Pads(self.scene, model, num_envs, self.config.control_dt_s, device, threads, shear)
        window = max(1, round(self.config.limits.force_window_s / self.scene.config.timestep_s))
        self._episode = EpisodeState.empty(self.scene, num_envs, window)
        self._episode.force_limit[:] = self.config.limits.contact_force_n
        self.force_limits_n = self._episode.force_limit
        """(N,) contact force [N] that ends every world's present episode."""
        self.tells_force_limit = self._randomizer.varies_force_limit
        self._rates = task.rate_limits(self.embodiment, self.config)
        self._parameters = dict(self._randomizer.draw(np.zeros(num_envs, np.int64)).values)
        eye = DEPTH_SENSORS[self.scene.config.depth_sensor]
        self._depth = DepthCamera(self.scene.model, self.scene.camera, num_envs, device, threads, eye)
        self._cache = StateCache(self.scene, self._backend, self._depth)
        self._settler = Settler(self.scene, self.config, self._backend, self._touch)
        self._drive = make_drive(self._backend, self.embodiment, self.substeps, self.config, robot_faults)

    @property
    def embodiment(self) -> Embodiment:
        """The robot."""
        return self.scene.embodiment

    @property
    def device(self) -> str:
        """Torch device on which sensors are computed."""
        return self._backend.device

    @property
    def episode_steps(self) -> int:
        """Control steps until the time-out."""
        return self.config.steps_of(self.scene.config.start)

    @property
    def seeds(self) -> Array:
        """(N,) seed of every world's present episode."""
        return self._episode.seed

    @property
    def steps(self) -> Array:
        """(N,) control steps done in every world's present episode."""
        return self._episode.steps

    @property
    def seated_s(self) -> Array:
        """(N,) for how long each plug has been seated without interruption; NaN where it is not seated."""
        return self._episode.seated_s(self.config.control_dt_s)

    @property
    def in_hand(self) -> Array:
        """(N,) whether all parts that hands are to take are grasped and lifted, or were so from the start."""
        lifted = in_hand(self.scene, self._episode.grasped & self._episode.lifted)
        return lifted | (self.scene.config.start == "grasped")

    @property
    def camera_intrinsics(self) -> Array:
        """(4,) float32 fx, fy, cx, cy [pixels]."""
        return self.scene.camera.intrinsics

    @property
    def camera_pose(self) -> Array:
        """(N, 7) float32 position [m] and quaternion (w, x, y, z) of the optical frame in the world."""
        return self._depth.pose.copy()

    @without_torch_threads
    def reset(self, ids: Array, seeds: Array, start: starts.Start | None = None) -> None:
        """Start new episodes in worlds `ids` (m,); each is a pure function of its seed (m,), and of `start`
        where one is given in place of the seed's.
        """
        ids = self._checked(ids)
        self._cache.forget()
        seeds = np.broadcast_to(np.asarray(seeds, np.int64), ids.shape)
        drawn = self._randomizer.draw(seeds)
        self._apply(ids, drawn)
        state = self._episode
        state.clear(ids)
        state.seed[ids] = seeds
        state.force_limit[ids] = self._randomizer.force_limits(seeds, self.config.limits.contact_force_n)
        command, state.pad_load[ids] = self._settler.settle(ids, seeds, start)
        state.command[ids] = self._drive.reset(ids, command)
        state.pad_force[ids] = state.pad_load[ids][..., 0]
        self._pads.reset(ids, seeds, drawn.values)
        seen = self._cache.see(ids)
        state.grasped[ids] = self.scene.config.start == "grasped"
        state.reference[ids] = seen.grip_points
        state.tip[ids] = seen.insertion.position_m
        self._remember(ids)

    @without_torch_threads
    def step(self, action: Array, ids: Array | None = None, images: Array | None = None) -> StepResult:
        """One control step of worlds `ids` (m,), all by default.

        Args:
            action: (m, J) absolute joint targets [rad, m]. They are clamped to the joint limits and to the
                rate limits, and approached linearly over the control step.
            images: worlds whose depth images are asked for next, sorted; they are begun at once, beside all
                else. None by default.
        """
        ids = self._checked(ids)
        action = task.checked_action(action, (len(ids), self.scene.embodiment.num_joints))
        state = self._episode
        before = state.command[ids]
        wanted = task.servo_commands(self.scene.embodiment, action)
        after = np.clip(wanted, before - self._rates, before + self._rates)
        earlier = [torch.as_tensor(item[ids], device=self.device) for item in (state.tip, state.force_tail)]
        self._cache.forget()
        trace = self._drive.advance(ids, before, after)
        state.command[ids] = after
        measured = self._start_measuring(ids, trace, earlier)
        if images is not None and len(images):
            self._cache.start_images(self._checked(images), state.moments(images, after=ids))
        reward = update(state, ids, measured(), self.config, self.scene)
        self._remember(ids)
        terminated = state.done[ids]
        truncated = ~terminated & (state.steps[ids] >= self.episode_steps)
        return StepResult(reward, terminated, truncated, state.success[ids])

    @without_torch_threads
    def observe(self, ids: Array | None = None) -> dict[str, Array]:
        """What the sensors give now, as the hardware would.

        Returns:
            `state` (m, J) float32 [rad, m]; `tactile` and `tactile_baseline` (m, P, T) uint8 counts;
            `depth_mm` (m, H, W) uint16, 0 where nothing is measured within 2 m. And what a person would say:
            `limits` (m, 2) float32 on force [N] and shift in the hand [m], where these differ.
        """
        copied = {name: start_copy(values) for name, values in self.observe_tensors(ids).items()}
        frames = {name: wait() for name, wait in copied.items()}
        return frames | {"depth_mm": frames["depth_mm"].view(np.uint16)}

    @without_torch_threads
    def observe_tensors(self, ids: Array | None = None) -> dict[str, torch.Tensor]:
        """The same as tensors on `device`, where cameras and pads leave them; `depth_mm` is int16."""
        ids = self._checked(ids)
        limits = self._episode.limits(ids, self.config.limits)
        return {
            **({"limits": torch.as_tensor(limits, device=self.device)} if self.tells_force_limit else {}),
            "state": torch.as_tensor(self.joint_state(ids), device=self.device),
            "tactile": self._pads.counts(ids, self._touch_at(ids)),
            "tactile_baseline": self._pads.baseline(ids),
            "depth_mm": self._cache.images(ids, self._episode.moments(ids)),
        }

    def joint_state(self, ids: Array | None = None) -> Array:
        """The `state` part of `observe` alone: (m, J) float32."""
        joints = self._cache.see(self._checked(ids)).joints
        return self._drive.readings(joints).astype(np.float32)

    @without_torch_threads
    def tactile(self, ids: Array | None = None) -> Array:
        """The `tactile` part of `observe` alone: (m, P, T) uint8 counts."""
        ids = self._checked(ids)
        return to_host(self._pads.counts(ids, self._touch_at(ids)))

    def shear(self, ids: Array | None = None) -> Array:
        """Tangential forces on the taxels at the end of the last control step, (m, P, T, 2) float32 [N]:
        along x and y of the pad's frame.

        They add up to the solver's tangential force on that pad, and none exceeds friction times the
        taxel's normal force. Both hold for the `consistent` contact model; others do not conserve the load.

        Raises:
            ValueError: shear is off.
        """
        return self._pads.shear(self._checked(ids))

    def hold(self) -> None:
        """Let the physics of one control step pass under the present commands, and nothing else."""
        command = self._episode.command
        everyone = np.arange(self.num_envs)
        self._cache.forget()
        self._backend.advance_linearly(everyone, command, command, self.substeps)
        self._backend.diverged(everyone)  # waits for it

    def depth_mm(self, ids: Array | None = None) -> Array:
        """Depth images (m, H, W) uint16 [mm]."""
        ids = self._checked(ids)
        return to_host(self._cache.images(ids, self._episode.moments(ids))).view(np.uint16)

    def geometry(self, ids: Array) -> tuple[Array | torch.Tensor, Array | torch.Tensor, Array]:
        """Geoms as cameras see them: positions (m, G, 3), rotations (m, G, 3, 3), sizes (m, G, 3)."""
        return *self._backend.geom_poses(ids), self._depth.sizes(ids)

    def command_targets(self, ids: Array | None = None) -> Array:
        """Joint targets (m, J) that the servos hold at the end of the last control step."""
        return task.joint_targets(self.scene.embodiment, self._episode.command[self._checked(ids)])

    def part_poses(self, ids: Array | None = None) -> tuple[Array, Array]:
        """Poses (m, 7) of plug and socket: position [m], quaternion (w, x, y, z)."""
        qpos, _ = self._backend.read(self._checked(ids))
        return qpos[:, self.scene.addresses.plug_qpos], qpos[:, self.scene.addresses.socket_qpos]

    def insertion(self, ids: Array | None = None) -> task.Insertion:
        """Where each plug is with respect to its socket."""
        return self._cache.see(self._checked(ids)).insertion

    def part_touch(self, ids: Array | None = None) -> Array:
        """Whether plug and socket touch, 0 or 1, and where in the socket's frame [m]: (m, 4)."""
        return self._episode.touch[self._checked(ids)]

    def privileged(self, ids: Array | None = None) -> Array:
        """State for a critic, (m, P) float32, columns named by `privileged_names`."""
        return self._describe(self._checked(ids)).vector

    @property
    def privileged_names(self) -> tuple[str, ...]:
        """(P,) names."""
        return self._describe(np.arange(1)).names

    def metrics(self, ids: Array | None = None) -> dict[str, Array]:
        """How the episodes went so far, (m,) each; `failure` indexes `FAILURES`, no success has time NaN."""
        ids = self._checked(ids)
        found = self._episode.metrics(ids, self.config.control_dt_s)
        return found | {"depth_m": self.insertion(ids).depth_m}

    def get_state(self, env: int) -> dict[str, Any]:
        """Everything that world `env`'s future depends on."""
        return {
            "row": self._backend.get_rows(np.array([env]))[0],
            "episode": self._episode.row(env),
            "parameters": {name: values[env] for name, values in self._parameters.items()},
            "camera": (self._depth.position[env].copy(), self._depth.rotation[env].copy()),
            "pads": self._pads.get_state(env),
            "drive": self._drive.get_state(env),
        }

    @without_torch_threads
    def set_state(self, env: int | Array, state: dict[str, Any]) -> None:
        """Continue world `env` from a state taken by `get_state`; of several worlds (m,), every value of the
        state is (m, ...).
        """
        ids = np.atleast_1d(env)
        values = {name: np.atleast_1d(value) for name, value in state["parameters"].items()}
        position, rotation = (np.reshape(part, (-1, *part.shape[np.ndim(env) :])) for part in state["camera"])
        self._cache.forget()
        self._apply(ids, WorldParameters(values, position, rotation))
        self._backend.set_rows(ids, np.reshape(state["row"], (len(ids), -1)))
        self._episode.set_row(env, state["episode"])
        self._pads.set_state(env, state["pads"])
        self._drive.set_state(env, state["drive"])

    def mj_data(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of one world with derived quantities, for rendering; not live."""
        return self._backend.instance(env)

    def _checked(self, ids: Array | None) -> Array:
        if ids is None:
            return np.arange(self.num_envs)
        ids = np.atleast_1d(np.asarray(ids, np.int64))
        if len(ids) and (ids[0] < 0 or ids[-1] >= self.num_envs or (np.diff(ids) <= 0).any()):
            raise ValueError(f"ids must be sorted, unique and below {self.num_envs}, got {ids}")
        return ids

    def _apply(self, ids: Array, drawn: WorldParameters) -> None:
        for name in RANGES:
            self._parameters[name][ids] = drawn.values[name]
        self._depth.set_cameras(ids, drawn.camera_position, drawn.camera_rotation)
        if self._randomizer.changes_physics:
            fields = self._randomizer.model_fields(drawn)
            self._backend.set_fields(ids, fields)
            if "geom_size" in fields:
                self._depth.set_shapes(ids, fields["geom_size"], fields["geom_aabb"])

    def _touch_at(self, ids: Array) -> Touch:
        return self._touch(ids, lambda: self._cache.see(ids), self._episode.pad_load[ids])

    def _remember(self, ids: Array) -> None:
        if self._pads.remembers:
            self._pads.advance(ids, self._touch_at(ids))

    def _start_measuring(
        self, ids: Array, trace: Trace, earlier: list[torch.Tensor]
    ) -> Callable[[], Measured]:
        """Ask for all that follows from a trace before waiting for any of it: a GPU then never idles."""
        scene, pair = self.scene, self.scene.pair
        summary = start_summary(trace, scene.addresses, scene.config.timestep_s, *earlier, pair.mouth_z_m)
        load = self._touch.start_load(ids, trace, lambda: self._cache.see(ids))
        state = self._backend.start_read(ids)

        def wait() -> Measured:
            seen = self._cache.see(ids, state())
            rest = np.array([pair.socket.rest_height_m, pair.plug.rest_height_m])
            positions = seen.parts[0][:, ::-1]
            return Measured(
                insertion=seen.insertion,
                grip_points=seen.grip_points,
                part_heights=positions[..., 2] - rest - scene.config.table_height_m,
                part_positions=positions,
                substeps=summary(),
                pad_load=load(),
                diverged=self._backend.diverged(ids),
                overflowed=self._backend.overflowed(ids),
            )

        return wait

    def _describe(self, ids: Array) -> Privileged:
        seen, told = self._cache.see(ids), self.tells_force_limit
        return describe(self.scene, self.config, self._episode, ids, seen, self._parameters, told)
