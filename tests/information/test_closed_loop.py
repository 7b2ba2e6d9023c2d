"""The scripted expert on the truth, and on what is believed."""

import numpy as np
import torch

from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.factory import make_episodes
from lerobot_vtrefine.information.closed_loop import Believer, expert_success, play
from lerobot_vtrefine.information.quantities import NAMES, Grasps
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.ik import hand_poses


def test_the_expert_succeeds_on_the_truth() -> None:
    env = VtRefineEnvConfig(start="grasped")
    done = expert_success(env, 4, 4, None, {}, Grasps(np.tile(np.eye(3), (3, 1, 1))), torch.device("cpu"))
    assert done.tolist() == [True] * 4


def test_parts_are_grasped_by_the_truth_and_inserted_by_estimates() -> None:
    """Whose estimates are far off picks both parts up from the table, and then misses the hole."""
    env = VtRefineEnvConfig(start="table", backend="single")
    episodes = make_episodes(env, 1)
    sim = episodes.sim
    offset_m = 0.03

    class Misled:
        history = 1

        def __call__(self, window: dict[str, torch.Tensor]) -> torch.Tensor:
            estimate = torch.zeros(len(window["state"]), len(NAMES))
            estimate[:, NAMES.index("plug_in_hand_x")] = offset_m
            return estimate

    grasps = Grasps(np.tile(np.eye(3), (3, 1, 1)))
    believer = Believer(episodes, Misled(), {}, grasps, torch.device("cpu"))  # type: ignore[arg-type]
    seen: list[tuple[bool, bool, bool]] = []

    def part_poses(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        plug, socket = believer.part_poses(rows)
        plug_in_hand = hand_poses(sim.scene.embodiment, np.asarray(sim.joint_state(rows), float))
        held_m = np.linalg.norm(plug[0, :3] - plug_in_hand[0][0, 1])
        true = np.array_equal(np.stack([plug, socket]), np.stack(sim.part_poses(rows)))
        seen.append((bool(sim.in_hand[0]), true, bool(abs(held_m - offset_m) < 1e-9)))
        return plug, socket

    assert not play(episodes, ScriptedExpert(sim, part_poses=part_poses), 1, believer).any()
    assert {(False, True, False), (True, False, True)} == set(seen), "the truth, then estimates alone"
