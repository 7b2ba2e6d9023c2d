"""Joint targets of both arms from wanted hand poses, by mink: limits, collisions, posture, warm start.

Shapes: J joints of both arms, H hands.
"""

from functools import cached_property
from typing import Any

import mink
import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig
from lerobot_vtrefine.sim.scene import build_arms
from lerobot_vtrefine.teleoperators.hand_motion import Pose
from lerobot_vtrefine.teleoperators.table_limit import TableLimit

Array = NDArray[np.float64]

LEAST_STEPS = 2
"""Solver's steps per control step: with a warm start a second one leaves less than 0.1 mm."""
LONGEST_STEP_S = 0.01
"""No solver's step is longer: arms that look ahead by `LOOK_AHEAD_M` then cannot pass through each other."""
POSTURE_COST = 1e-3
"""Pulls towards the last joint positions; small, so that it decides only what the hands leave open."""
ORIENTATION_COST = 0.2
"""One radian weighs as much as this many metres."""
DAMPING = 1e-4
HANDS_APART_M = 0.004
LOOK_AHEAD_M = 0.03
"""Closer geoms than this enter the solver."""
APPROACH = 0.5
"""Largest share of the distance that is left by which a step may bring things closer."""
PARTING_M_S = 0.01
"""What has come closer than `HANDS_APART_M`, as curved ways do little by little, is moved apart this fast."""
SOLVER = "daqp"


class TwoArmIk:
    """Inverse kinematics of an embodiment's arms, one control step after the other.

    Args:
        embodiment: its name.
        dt_s: control step.
        speed: share of the simulation's rate limits that joints may use.
    """

    def __init__(self, embodiment: str, dt_s: float, speed: float = 1.0) -> None:
        self.model, self.body, self._qpos = build_arms(SceneConfig(embodiment=embodiment))
        rules = TaskConfig()
        self._dt_s, self._steps = dt_s, max(LEAST_STEPS, round(dt_s / LONGEST_STEP_S))
        rate = np.full(self.body.num_joints, self.body.fingers.command_rate(rules.finger_rate))
        rate[self.body.arm_columns] = rules.joint_rate
        self._rate = rate * speed
        self._configuration = mink.Configuration(self.model)
        self._is_finger = np.ones(self.body.num_joints, bool)
        self._is_finger[self.body.arm_columns] = False
        self._bodies = [self._hand_body(hand) for hand in range(len(self.body.arms))]
        names = [self.model.body(body).name for body in self._bodies]
        self._tasks = [mink.FrameTask(name, "body", 1.0, ORIENTATION_COST, lm_damping=1e-6) for name in names]
        self._posture = mink.PostureTask(self.model, POSTURE_COST)
        limited = {self.model.joint(int(j)).name: r for j, r in zip(self._joints, self._rate, strict=True)}
        self._limits: list[Any] = [
            mink.ConfigurationLimit(self.model),
            mink.VelocityLimit(self.model, limited),
            *self._collisions(),
        ]
        self.restart(np.asarray(self.body.home, float))

    @cached_property
    def _joints(self) -> Array:
        """(J,) joint ids in the embodiment's order."""
        by_address = {int(address): joint for joint, address in enumerate(self.model.jnt_qposadr)}
        return np.array([by_address[int(address)] for address in self._qpos])

    def restart(self, joints: Array) -> None:
        """The arms are at joint positions (J,)."""
        self.joints = np.clip(joints, self.body.lower, self.body.upper)
        qpos = self._configuration.q.copy()
        qpos[self._qpos] = self.joints
        self._configuration.update(qpos)

    def hands(self, joints: Array | None = None) -> list[Pose]:
        """Poses of the TCPs at joint positions (J,); at the present ones by default."""
        q = torch.as_tensor(self.joints if joints is None else joints)
        position, rotation = self.body.tcp_poses(q)
        return [Pose(p.numpy(), r.numpy()) for p, r in zip(position, rotation, strict=True)]

    def step(self, wanted: list[Pose], grips: list[float | None]) -> Array:
        """One control step towards wanted hand poses (H) and grips (H, 0 open, 1 closed, None as it is).

        Returns:
            Joint targets (J,), no farther from the last ones than the rate limits allow, whatever is asked.
        """
        before, most = self.joints.copy(), self._rate * self._dt_s
        fingers = before + np.clip(self._fingers(before, grips) - before, -most, most)
        self.restart(fingers)  # the point between some grippers' pads moves as they close
        for hand, (task, pose, tcp) in enumerate(zip(self._tasks, wanted, self.hands(), strict=True)):
            position, rotation = self._in_hand(hand, tcp)
            turned = pose.rotation @ rotation.T
            target = mink.SE3.from_rotation_and_translation(
                mink.SO3.from_matrix(turned), pose.position - turned @ position
            )
            task.set_target(target)
        self._posture.set_target(self._configuration.q)
        try:
            for _ in range(self._steps):
                velocity = mink.solve_ik(
                    self._configuration,
                    [*self._tasks, self._posture],
                    self._dt_s / self._steps,
                    SOLVER,
                    DAMPING,
                    limits=self._limits,
                )
                self._configuration.integrate_inplace(velocity, self._dt_s / self._steps)
            solved = self._configuration.q[self._qpos]
        except mink.exceptions.MinkError:  # nothing satisfies all limits: stay
            solved = before
        targets = np.where(self._is_finger, fingers, solved)
        targets = np.where(np.isfinite(targets), targets, before)
        self.restart(before + np.clip(targets - before, -most, most))
        return self.joints

    def _fingers(self, before: Array, grips: list[float | None]) -> Array:
        """(J,) finger positions for these grips; arm joints mean nothing."""
        targets, openings = before.copy(), self.body.openings(before).copy()
        for hand, grip in enumerate(grips):
            if grip is not None:
                openings[hand] = (1.0 - grip) * self.body.fingers.travel_m
        self.body.set_openings(targets, openings)
        return targets

    def _hand_body(self, hand: int) -> int:
        """The body that carries a hand."""
        last = self.body.by_arm(self._joints)[hand, len(self.body.joints) - 1]
        return int(self.model.jnt_bodyid[last])

    def _in_hand(self, hand: int, tcp: Pose) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) of a TCP in its hand's body; some reach less far opened."""
        data, body = self._configuration.data, self._bodies[hand]
        turned = data.xmat[body].reshape(3, 3)
        return turned.T @ (tcp.position - data.xpos[body]), turned.T @ tcp.rotation

    def _collisions(self) -> list[mink.Limit]:
        """The arms' solid parts against each other and against what does not move, which is the table."""
        solid = np.flatnonzero(self.model.geom_contype | self.model.geom_conaffinity)
        root = self.model.body_rootid[self.model.geom_bodyid]
        arms = self._joints.reshape(len(self.body.arms), -1)
        roots = [self.model.body_rootid[self.model.jnt_bodyid[joints[0]]] for joints in arms]
        sides = [[int(g) for g in solid if root[g] == side] for side in roots]
        fixed = [int(g) for g in solid if self.model.geom_bodyid[g] == 0]
        is_box = self.model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
        boxes = [g for side in sides for g in side if is_box[g]]
        pairs = [([g for side in sides for g in side if not is_box[g]], fixed)]
        if len(sides) == 2:
            pairs.append((sides[0], sides[1]))
        step_s = self._dt_s / self._steps
        apart = mink.CollisionAvoidanceLimit(
            self.model,
            pairs,
            gain=APPROACH * step_s,  # mink 1.3 bounds a step's way by gain * distance / dt
            minimum_distance_from_collisions=HANDS_APART_M,
            collision_detection_distance=LOOK_AHEAD_M,
            bound_relaxation=-PARTING_M_S * step_s,
        )
        top_m = self.model.geom("table").pos[2] + self.model.geom("table").size[2]
        table = TableLimit(self.model, boxes, top_m, HANDS_APART_M, LOOK_AHEAD_M, APPROACH, PARTING_M_S)
        return [apart, table]
