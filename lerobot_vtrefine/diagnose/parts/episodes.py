"""Episodes of the twin's own robot, with what the pads say about when parts are held and when they meet.

Shapes: T frames, J joints, A hands in the order of the body's arms. Nothing here uses what only a simulator
knows: a simulated dataset's note says which scene was *assumed*, not how its episodes began or which faults
were hidden in them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from lerobot_vtrefine.datasets.episodes import EpisodeFolder, RecordedEpisode, open_episodes
from lerobot_vtrefine.diagnose.episode_replay.twin import read_ledger, recorded_twin
from lerobot_vtrefine.diagnose.parts.rules import (
    APART_M,
    CLEAR_M,
    HELD_TAXELS,
    LIFTED_M,
    SETTLE_S,
    SIDEWAYS_M,
    TOUCHED_COUNTS,
)
from lerobot_vtrefine.embodiments import Embodiment, get_embodiment
from lerobot_vtrefine.embodiments.embodiment import PARTS
from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig
from lerobot_vtrefine.sim.pairs import Part, PartPair, load_pair

Array = np.ndarray

GRAVITY_M_S2 = 9.81


@dataclass(frozen=True)
class AssumedScene:
    """What the simulation believes about an episode: its scene, its rules, the parts."""

    scene: SceneConfig
    rules: TaskConfig
    pair: PartPair

    @property
    def body(self) -> Embodiment:
        """The robot."""
        return get_embodiment(self.scene.embodiment)

    @property
    def parts(self) -> tuple[Part, ...]:
        """(A,) the part that is every hand's."""
        return tuple(getattr(self.pair, arm.holds) for arm in self.body.arms)

    def hand_of(self, part: str) -> int | None:
        """Which hand holds the part in this scene; None if none does, see `unheld`."""
        return None if self.unheld(part) else self.body.holders[PARTS.index(part)]

    def unheld(self, part: str) -> str:
        """Why no hand holds the part; empty where one does."""
        if part == "socket" and self.scene.socket == "stands":
            return "the socket stands on the table, and no hand holds it"
        if self.body.holders[PARTS.index(part)] is None:
            return f"{self.body.name} has no hand that holds the {part}"
        if self.body.pads_per_arm < 2:
            return (
                f"{self.body.name} has one pad per hand: whether it holds the {part} takes two opposite ones"
            )
        return ""

    def weights_n(self, episodes: "Sequence[HandledEpisode]", mass_kg: Array) -> list[Array]:
        """Per episode (T, A): the weight that hangs in each hand, for masses (2,) of socket and plug."""
        own = mass_kg[[PARTS.index(arm.holds) for arm in self.body.arms]]
        return [episode.hanging * own * GRAVITY_M_S2 for episode in episodes]


@dataclass(frozen=True)
class HandledEpisode:
    """One episode and which of its frames mean what."""

    index: int
    time_s: Array
    """(T,) from the episode's start."""
    position: Array
    """(T, J)"""
    command: Array
    """(T, J)"""
    touched: Array
    """(T, A) bool: some taxel of the hand is pressed."""
    held: Array
    """(T, A) bool: both pads of the hand are pressed."""
    hanging: Array
    """(T, A) bool: the hand carries a part's weight."""
    carried: Array
    """(T, A) bool: and has done so for a while, and nothing else touches the part."""
    free: Array
    """(T, A) bool: the hand is empty and has been so for a while."""
    together: Array
    """(T,) bool: all hands hold their parts, so close that these may touch."""


def assumed_scene(folder: EpisodeFolder) -> AssumedScene | None:
    """The scene that a simulated dataset was thought to show; None for any other dataset."""
    ledger = read_ledger(folder)
    if ledger is None:
        return None
    env = recorded_twin(ledger, folder.fps)
    return AssumedScene(env.scene_config, env.task_config, load_pair(env.scene_config))


def read_episodes(root: Path, scene: AssumedScene) -> tuple[HandledEpisode, ...]:
    """All episodes of a dataset of the scene's robot; without pads nothing counts as held."""
    return tuple(handled(episode, scene) for episode in open_episodes(root).read())


def handled(episode: RecordedEpisode, scene: AssumedScene) -> HandledEpisode:
    """An episode's phases, by its pads and the positions of its hands."""
    body, count = scene.body, len(episode.state)
    pressed = np.zeros((count, len(body.pad_names)), dtype=int)
    for place, name in enumerate(body.pad_names):
        if name in episode.counts:
            above = episode.counts[name].astype(int) - episode.baselines[name].astype(int)
            pressed[:, place] = (above > TOUCHED_COUNTS).sum(1)
    pressed = pressed.reshape(count, body.num_arms, body.pads_per_arm)
    touched = pressed.max(2) > 0
    held = (pressed.min(2) >= HELD_TAXELS) & (body.pads_per_arm > 1)
    tip, _ = hands(body, episode.state)
    apart, hanging = _apart(tip, held, scene), _raised(tip[..., 2], held, LIFTED_M)
    clear = _raised(tip[..., 2], held, CLEAR_M)
    settle = max(1, round(SETTLE_S / max(float(np.median(np.diff(episode.time_s))), 1e-3)))
    return HandledEpisode(
        index=episode.index,
        time_s=episode.time_s.astype(float) - float(episode.time_s[0]),
        position=episode.state,
        command=episode.action,
        touched=touched,
        held=held,
        hanging=hanging,
        carried=~lately(~hanging, settle) & clear & apart[:, None],
        free=~lately(touched, settle),
        together=held.all(1) & ~apart,
    )


def hands(body: Embodiment, joints: Array) -> tuple[Array, Array]:
    """TCP positions (T, A, 3) [m] and rotations (T, A, 3, 3) at joints (T, J)."""
    position, rotation = body.tcp_poses(torch.as_tensor(np.asarray(joints, dtype=float)))
    return position.numpy(), rotation.numpy()


def without_hands(body: Embodiment, episode: HandledEpisode) -> Array:
    """(T, J) commands under which the twin's empty fingers stand where the real ones hold their parts."""
    command = episode.command.copy()
    fingers = body.by_arm(command)[..., len(body.joints) :]
    recorded = body.by_arm(episode.position)[..., len(body.joints) :]
    fingers[...] = np.where(episode.held[..., None], recorded, fingers)
    return command


def _raised(height: Array, held: Array, least_m: float) -> Array:
    """(T, A): held, and higher than where it was grasped; parts held from the start count as raised."""
    out = np.zeros_like(held)
    for hand in range(held.shape[1]):
        frames = np.flatnonzero(held[:, hand])
        if not len(frames):
            continue
        first = int(frames[0])
        up = height[:, hand] > height[first, hand] + least_m
        out[:, hand] = held[:, hand] & (up if first else True)
    return out


def lately(event: Array, frames: int) -> Array:
    """(T, A): now, in the next frame, or within the last few ones."""
    out = event.copy()
    out[:-1] |= event[1:]
    for lag in range(1, min(frames, len(event) - 1) + 1):
        out[lag:] |= event[:-lag]
    return out


def _apart(tip: Array, held: Array, scene: AssumedScene) -> Array:
    """(T,): the parts, held ideally, are too far from each other to touch."""
    socket, plug = (scene.hand_of(part) for part in PARTS)
    if plug is None or not held[:, plug].any():
        return np.ones(len(tip), dtype=bool)
    lower_end = tip[:, plug] - [0.0, 0.0, scene.pair.plug.grip.centre_m[2]]
    if socket is None:
        mouth_m = scene.scene.table_height_m + scene.pair.socket.rest_height_m + scene.pair.mouth_z_m
        return lower_end[:, 2] - mouth_m > APART_M
    if not held.all(1).any():
        return np.ones(len(tip), dtype=bool)
    mouth = tip[:, socket] + [0.0, 0.0, scene.pair.mouth_z_m - scene.pair.socket.grip.centre_m[2]]
    between = lower_end - mouth
    sideways = np.hypot(between[:, 0], between[:, 1]) > SIDEWAYS_M
    return sideways | (between[:, 2] > APART_M)
