"""A minimal privileged controller for tests: align the plug above the mouth, then push it in."""

import numpy as np
import torch

from lerobot_vtrefine.embodiments.kinematics import rotation_error
from lerobot_vtrefine.sim.rotations import quat_to_matrix
from lerobot_vtrefine.sim.simulation import InsertionSim


class Guide:
    """Moves the right hand only; `bias_m` (2,) keeps the plug off the socket's axis."""

    def __init__(self, sim: InsertionSim, bias_m=(0.0, 0.0), speed_m=0.004):
        self.sim, self.bias, self.speed = sim, np.asarray(bias_m), speed_m

    def reset(self, ids):
        self.ids = ids
        self.joints = self.sim.command_targets(ids)
        position, rotation = self.sim.embodiment.tcp_poses(torch.from_numpy(self.joints))
        self.position, self.rotation = position.numpy(), rotation.numpy()

    def act(self):
        sim = self.sim
        plug, socket = sim.part_poses(self.ids)
        plug_rotation, socket_rotation = quat_to_matrix(plug[:, 3:]), quat_to_matrix(socket[:, 3:])
        state = sim.insertion(self.ids)
        lateral = self.bias - state.position_m[:, :2]
        aligned = (np.linalg.norm(lateral, axis=1) < 7e-4) & (state.tilt_rad < 0.02)
        down = np.where(aligned | (state.depth_m > 0.002), self.speed, 0.0)
        wanted = np.concatenate([np.clip(lateral, -2e-3, 2e-3) * 0.7, -down[:, None]], 1)
        self.position[:, 1] += np.einsum("mij,mj->mi", socket_rotation, wanted)
        spin = rotation_error(torch.from_numpy(plug_rotation), torch.from_numpy(socket_rotation)).numpy()
        spin = np.clip(spin, -0.03, 0.03) * 0.7
        self.rotation[:, 1] = small_rotation(spin) @ self.rotation[:, 1]
        # Turning about the TCP moves the tip: let the position controller make up for it.
        goal = sim.embodiment.solve_tcp(
            torch.from_numpy(self.position), torch.from_numpy(self.rotation), torch.from_numpy(self.joints), 6
        ).numpy()
        goal[:, [6, 7, 14, 15]] = self.joints[:, [6, 7, 14, 15]]
        self.joints = goal
        return goal


def small_rotation(vector):
    angle = np.linalg.norm(vector, axis=-1)[:, None, None]
    x, y, z = vector.T
    zero = np.zeros_like(x)
    skew = np.stack(
        [np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2
    )
    return np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * skew @ skew


def run(sim, guide, seeds, steps):
    """Successes (m,) and the metrics after `steps` control steps at most."""
    ids = np.arange(len(seeds))
    sim.reset(ids, seeds)
    guide.reset(ids)
    for _ in range(steps):
        result = sim.step(guide.act(), ids)
        if (result.terminated | result.truncated).all():
            break
    return sim.metrics(ids)
