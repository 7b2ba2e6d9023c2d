"""Frames with the truth beside them: an expert that misjudges where things are, in many worlds.

Its errors are larger than those of demonstrations, so that plugs land beside the hole, on its rim and askew:
the contacts that a policy meets while it learns. It also misjudges how the parts lie in the hands, by up to
as much as they may have slipped: where it brings the hands would otherwise tell the joints what is hidden.
Shapes: ``E`` episodes, ``T`` frames of the longest, ``m`` worlds.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import radians
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from lerobot.envs.utils import preprocess_observation
from torch import Tensor

from lerobot_vtrefine.datasets.features import STATE_KEY, raw_to_env_observation
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.envs.factory import make_episodes
from lerobot_vtrefine.information.quantities import NAMES, Grasps, Relative, observe
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.ik import hand_poses
from lerobot_vtrefine.sim.poses import Poses

if TYPE_CHECKING:
    from lerobot_vtrefine.embodiments import Embodiment
    from lerobot_vtrefine.sim.simulation import InsertionSim

ERRORS = Degradation(
    lateral_std_m=2.5e-3,
    tilt_std_rad=radians(3.0),
    grasp_std_m=3e-3,
    tremor_std_m=8e-4,
    pause_probability=0.02,
    pace_std=0.2,
)
"""Misses a hole of 1 to 2 mm more often than not."""
FIRST_SEED = 3_000_000
"""Apart from the seeds of demonstrations, training and evaluation."""


class View(Protocol):
    """What makes new columns of raw ones, such as ``VisuoTactileProcessorStep``."""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """A frame (m, ...) with the new columns."""
        ...


Views = Mapping[str, View]
"""How frames are seen; the name of a view is the prefix of its columns."""


@dataclass
class Frames:
    """All frames that were recorded."""

    columns: dict[str, Tensor]
    """(E, T, ...) each: what the views made of a frame, and ``state`` in rad and m."""
    truth: Tensor
    """(E, T, K) quantities."""
    length: Tensor
    """(E,) frames of each episode."""
    grasps: Grasps
    contact: Tensor
    """(E, T, 4) as of ``InsertionSim.part_touch``."""
    held: Tensor
    """(E, T) bool: both parts are in their hands. From the table this comes later, or never."""

    def split(self, share: float) -> tuple["Frames", "Frames"]:
        """The first episodes for training, a ``share`` of them, and the others."""
        count = round(share * len(self.length))
        return self._part(slice(None, count)), self._part(slice(count, None))

    def _part(self, rows: slice) -> "Frames":
        columns = {key: value[rows] for key, value in self.columns.items()}
        truth, length, contact = self.truth[rows], self.length[rows], self.contact[rows]
        return Frames(columns, truth, length, self.grasps, contact, self.held[rows])

    def index(self) -> tuple[Tensor, Tensor]:
        """Episode and frame number of every frame, (N,) each."""
        frames = torch.arange(self.truth.shape[1], device=self.length.device)
        episode, frame = (frames < self.length[:, None]).nonzero(as_tuple=True)
        return episode, frame

    def held_index(self) -> tuple[Tensor, Tensor]:
        """Episode and frame number of every frame with both parts in hand, (N,) each."""
        episode, frame = self.held.nonzero(as_tuple=True)
        return episode, frame


class MisjudgedHolds:
    """Where parts seem to be to one who is wrong about how they lie in the hands, throughout an episode.

    Each episode draws the size of its errors, from none to the range of the task's slip, and the errors.
    """

    STREAM = 0x401D

    def __init__(self, sim: "InsertionSim") -> None:
        self._sim = sim
        self._error = Poses.identity(sim.num_envs, 2)

    def draw(self, ids: np.ndarray) -> None:
        """New errors for worlds ``ids`` (m,), a function of their episodes' seeds."""
        start = self._sim.config.grasped
        for env in ids:
            rng = np.random.default_rng([int(self._sim.seeds[env]), self.STREAM])
            ranges = np.array([*start.slip_xz_m, start.slip_rad])
            x, z, turn = ranges[:, None] * rng.uniform() * rng.uniform(-1, 1, (3, 2))
            none = np.zeros(2)
            slip, turned = np.stack([x, none, z], -1), np.stack([none, turn, none], -1)
            self._error.assign(env, Poses.from_vectors(slip, turned))

    def part_poses(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Believed poses of plug and socket, each (m, 7)."""
        q = np.asarray(self._sim.joint_state(ids), float)
        hands = Poses(*hand_poses(self._sim.scene.embodiment, q))
        plug, socket = self._sim.part_poses(ids)
        parts = Poses.from_quaternions(np.stack([socket, plug], 1))
        socket, plug = (hands @ self._error[ids] @ hands.inverse() @ parts).quaternions().swapaxes(0, 1)
        return plug, socket


def view_columns(
    raw: dict[str, Any], body: "Embodiment", views: Views, device: torch.device
) -> dict[str, Tensor]:
    """``VIEW/column`` (m, ...) of a body's raw frame (m, ...), and ``state`` (m, J)."""
    frame = preprocess_observation(raw_to_env_observation(raw, body))
    frame = {key: value.to(device) for key, value in frame.items() if isinstance(value, Tensor)}
    made = {
        f"{name}/{key}": value
        for name, view in views.items()
        for key, value in view.observation(dict(frame)).items()
        if key not in frame
    }
    return {**made, "state": frame[STATE_KEY].float()}


def collect_frames(
    config: VtRefineEnvConfig,
    num_episodes: int,
    num_envs: int,
    views: Views,
    device: torch.device,
    told: Callable[[int], None] = lambda _: None,
    first_seed: int = FIRST_SEED,
) -> Frames:
    """Frames of at least ``num_episodes`` episodes, ``num_envs`` at a time; ``told`` hears of every batch."""
    episodes = make_episodes(config, num_envs)
    holds = MisjudgedHolds(episodes.sim)
    expert = ScriptedExpert(episodes.sim, ERRORS, holds.part_poses)
    batches: list[_Batch] = []
    for first in range(0, num_episodes, num_envs):
        batches.append(_one_batch(episodes, holds, expert, first_seed + first, views, device))
        told(num_envs)
    length = np.concatenate([batch.length for batch in batches])
    held = np.concatenate([batch.held for batch in batches])
    if not held.any():
        raise ValueError(f"no episode of {num_episodes} got both parts into the hands")
    valid = np.arange(episode_frames(episodes)) < length[:, None]
    relative = Relative(*(np.concatenate(parts) for parts in zip(*(b.truth for b in batches), strict=True)))
    grasps = Grasps.mean(Relative(*(part[held] for part in relative)))
    truth = torch.zeros((*valid.shape, len(NAMES)))
    truth[torch.from_numpy(valid)] = torch.from_numpy(
        Relative(*(part[valid] for part in relative)).quantities(grasps)
    ).float()
    columns = {key: torch.cat([batch.columns[key] for batch in batches]) for key in batches[0].columns}
    contact = torch.from_numpy(np.concatenate([batch.contact for batch in batches])).float()
    ends = torch.from_numpy(length).to(device)
    in_hand = torch.from_numpy(held).to(device)
    return Frames(columns, truth.to(device), ends, grasps, contact.to(device), in_hand)


@dataclass
class _Batch:
    columns: dict[str, Tensor]  # (n, T, ...)
    truth: Relative  # (n, T, ...)
    contact: np.ndarray  # (n, T, 4)
    length: np.ndarray  # (n,)
    held: np.ndarray  # (n, T)


def _one_batch(
    episodes: Episodes,
    holds: MisjudgedHolds,
    expert: ScriptedExpert,
    first_seed: int,
    views: Views,
    device: torch.device,
) -> _Batch:
    sim, ids, frames = episodes.sim, episodes.ids, episode_frames(episodes)
    body = sim.scene.embodiment
    episodes.reset(ids, first_seed + ids)
    holds.draw(ids)
    expert.reset(ids)
    columns = {
        key: torch.zeros((len(ids), frames, *value.shape[1:]), dtype=value.dtype, device=device)
        for key, value in view_columns(_rows(episodes.raw, ids[:1]), body, views, device).items()
    }
    truth = Relative(*(np.zeros((len(ids), frames, *part.shape[1:])) for part in observe(sim, ids[:1])))
    contact, length = np.zeros((len(ids), frames, 4)), np.zeros(len(ids), np.int64)
    held = np.zeros((len(ids), frames), bool)
    targets = np.zeros((len(ids), body.num_joints))
    running = ids
    for frame in range(frames):
        rows = torch.as_tensor(running, device=device)
        for key, value in view_columns(_rows(episodes.raw, running), body, views, device).items():
            columns[key][rows, frame] = value
        for whole, part in zip(truth, observe(sim, running), strict=True):
            whole[running, frame] = part
        contact[running, frame] = sim.part_touch(running)
        held[running, frame] = sim.in_hand[running]
        length[running] += 1
        targets[running] = expert.act(running)
        episodes.step(targets)
        running = episodes.active
        if len(running) == 0:
            break
    return _Batch(columns, truth, contact, length, held)


def episode_frames(episodes: Episodes) -> int:
    """T: the frame before every control step of the longest episode."""
    sim = episodes.sim
    return sim.config.steps_of(sim.scene.config.start)


def _rows(raw: dict[str, Any], ids: np.ndarray) -> dict[str, Any]:
    return {key: value[ids] for key, value in raw.items()}
