"""A scripted expert that knows where everything is: it picks both parts, aligns them in the air and inserts.

Hands move along smooth paths from phase to phase. Where a part is in hand, the goal is a pose of the part:
how the hand holds it is measured, so that slip is corrected. Errors come from `Degradation` only.

Shapes: m environments; hands and parts are ordered left, right: the left hand takes the socket, the right
the plug.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.embodiments import Fingers
from lerobot_vtrefine.sim.demonstrations import Degradation, EpisodeErrors
from lerobot_vtrefine.sim.ik import hand_poses, solve_hands
from lerobot_vtrefine.sim.poses import Poses, rotation_vector
from lerobot_vtrefine.sim.servo_model import ServoModel
from lerobot_vtrefine.sim.starts import grip_openings, ideal_hand

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

PartPoses = Callable[[Ids], tuple[Array, Array]]
"""Environments (m,) -> poses of plug and socket, each (m, 7) as x y z [m] and qw qx qy qz."""

LEFT, RIGHT = 0, 1


class Phase(IntEnum):
    """What the expert does; start=grasped begins with ALIGN, parts that have been picked up with LIFT."""

    REACH = 0
    APPROACH = 1
    CLOSE = 2
    LIFT = 3
    CARRY = 4
    ALIGN = 5
    INSERT = 6
    HOLD = 7


@dataclass(frozen=True)
class Pace:
    """How one phase is timed."""

    speed_m_s: float
    """Mean speed of the hand that has the longer way."""
    shortest_s: float
    settle_m: float = np.inf
    """The phase ends when the hands (ALIGN: the plug) are this close to the goal ..."""
    patience_s: float = 0.0
    """... or this long after they should have arrived."""
    turn_m_per_rad: float = 0.1
    """A turn takes as long as this way."""


READY_M = 2e-4  # a plug this close to its aim may enter
PACES = {
    Phase.REACH: Pace(0.25, 1.0, 0.006, 0.5),
    Phase.APPROACH: Pace(0.12, 0.6, 0.003, 0.6),
    Phase.CLOSE: Pace(0.10, 0.7),
    Phase.LIFT: Pace(0.12, 0.8, 0.006, 0.4),
    Phase.CARRY: Pace(0.12, 0.6, 0.003, 0.5),
    Phase.ALIGN: Pace(0.04, 0.7, 8e-4, 0.5, turn_m_per_rad=0.2),
    Phase.INSERT: Pace(0.036, 0.5),
    Phase.HOLD: Pace(0.03, 0.5, 0.0, np.inf),
}
WRIST_RAD = 0.3  # a plug is turned towards its socket by so much; the socket comes to meet the rest
RETREAT_M = 0.09  # hands come to a part from this far behind it
CARRY_M = 0.040  # the plug is carried this high above the mouth
STANDOFF_M = 0.009  # and brought over it at this height
CLOSING_M_S = 0.012  # on the last way to the mouth: steady, so that friction keeps its direction
HOVER_M = 0.0012  # a plug that the descent has pushed off its aim waits here, at most so long
HOVER_S = 1.5
ENTRY_M = 0.0006  # below this height over the mouth nothing is corrected any more
PRESS_M = 0.008  # a blocked plug is pushed as if it should be this much lower: a few newtons
PRESS_N_PER_M = 820.0  # what that comes to on a rim, at most (a cross, friction 0.1 to 0.6)
PRESS_SHARE = 0.5  # of a limit on force that is told
RIM_M = 0.002  # a plug that is not this deep may stand on the rim
SLOWDOWN = 0.35  # before the seat: largest share of the way left in one control step
BOTTOM_M = 0.0005  # a seated plug is pushed this far beyond its seat
TABLE_GAP_M = 0.003  # between fingertips and table


@dataclass(frozen=True)
class View:
    """What the expert knows of m environments."""

    q: Array
    """(m, J) joint positions."""
    hands: Poses
    """(m, 2) TCPs."""
    parts: Poses
    """(m, 2) socket, plug."""

    @property
    def height_m(self) -> Array:
        """(m,) plugs' origins over their sockets'."""
        return (self.parts[:, LEFT].inverse() @ self.parts[:, RIGHT]).position[:, 2]

    def __getitem__(self, rows: NDArray) -> "View":
        return View(self.q[rows], self.hands[rows], self.parts[rows])


class ScriptedExpert:
    """Joint targets for any set of environments of one simulation.

    An environment's actions are a function of its own states and its episode's seed, so that an episode does
    not depend on how many run beside it.
    """

    def __init__(
        self,
        sim: "InsertionSim",
        degradation: Degradation | None = None,
        part_poses: PartPoses | None = None,
    ) -> None:
        """``part_poses``: where the parts are believed to be, in place of where they are."""
        self._sim = sim
        self._part_poses = part_poses or sim.part_poses
        self._robot = sim.scene.embodiment
        if None in self._robot.holders:
            raise ValueError(f"the scripted expert needs two hands, and {self._robot.name} has one")
        self._pair = sim.scene.pair
        self._hz = sim.config.control_hz
        self._from_table = sim.scene.config.start == "table"
        self._stands = sim.scene.config.socket == "stands"
        self._grasp, self._grip_m = _grasps(sim)
        self._stations = _stations(sim)
        count = sim.num_envs
        self._errors = EpisodeErrors(degradation or Degradation(), count, self._hz)
        self.phase = np.zeros(count, np.int64)
        self._step = np.zeros(count, np.int64)
        self._phase_step = np.zeros(count)  # control steps at the episode's pace
        self._duration = np.ones(count)  # of the phase, in control steps
        self._target = np.zeros((count, self._robot.num_joints))
        self._servos = ServoModel(sim)
        self._opening = np.zeros((count, 2))
        self._start = Poses.identity(count, 2)  # hands wanted when the phase began
        self._wanted = Poses.identity(count, 2)  # hands wanted now
        self._goal = Poses.identity(count, 2)  # hands wanted when the phase ends
        self._held = Poses.identity(count, 2)  # hands in their parts' frames, likewise
        self._socket = Poses.identity(count)  # where it was when the phase began, or the plug entered
        self._height_m = np.zeros(count)  # wanted height of the plug over the socket, while inserting
        self._entered = np.zeros(count, bool)
        self._press_m = np.full(count, PRESS_M)

    def reset(self, ids: Ids) -> None:
        """Start new episodes of environments `ids` (m,) after the simulation was reset, by its seeds."""
        ids = np.asarray(ids)
        self._errors.draw(ids, self._sim.seeds[ids])
        view = self._observe(ids)
        self._step[ids] = 0
        self._target[ids] = view.q
        if self._sim.tells_force_limit:
            gentle = PRESS_SHARE * self._sim.force_limits_n[ids] / PRESS_N_PER_M
            self._press_m[ids] = np.minimum(gentle, PRESS_M)
        self._servos.reset(ids, view.q, self._sim.command_targets(ids))
        self._wanted.assign(ids, view.hands)
        held = self._sim.in_hand[ids]
        self._opening[ids] = np.where(held[:, None], self._grip_m, self._robot.fingers.travel_m)
        if not held.all():
            self._enter(ids[~held], Phase.REACH, view[~held])
        if held.any():
            self._enter(ids[held], Phase.LIFT if self._from_table else Phase.ALIGN, view[held])

    def act(self, ids: Ids) -> Array:
        """Return absolute joint targets (m, J) for the next control step of environments `ids` (m,)."""
        ids = np.asarray(ids)
        view = self._observe(ids)
        self._advance(ids, view)
        moving = ~self._errors.paused(ids, self._step[ids])
        self._phase_step[ids] += moving * self._errors.pace[ids]
        self._descend(ids, view, moving)
        wanted = self._plan(ids, view)
        self._wanted.assign(ids[moving], wanted[moving])
        wanted = self._wanted[ids]
        start = self._target[ids]
        self._robot.set_grippers(start, view.q)  # whose angles decide where between swinging pads the TCP is
        target, _, _ = solve_hands(self._robot, wanted.position, wanted.rotation, start)
        # Servos that press against a contact lack something else than those that move freely.
        self._servos.learn(ids, view.q, (self.phase[ids] != Phase.CLOSE) & ~self._entered[ids])
        command = self._servos.command(ids, self._target[ids], target)
        for q in (target, command):
            self._robot.set_openings(q, self._opening[ids])
        self._target[ids] = target
        self._step[ids] += 1
        return np.clip(command, self._robot.lower, self._robot.upper)

    def _observe(self, ids: Ids) -> View:
        q = np.asarray(self._sim.joint_state(ids), float)
        plug, socket = self._part_poses(ids)
        return View(
            q, Poses(*hand_poses(self._robot, q)), Poses.from_quaternions(np.stack([socket, plug], 1))
        )

    def _advance(self, ids: Ids, view: View) -> None:
        """Move environments whose phase is over to the next one, one phase at most."""
        phases = self.phase[ids]
        late_s = (self._phase_step[ids] - self._duration[ids]) / self._hz
        miss = _distance(view.hands, self._goal[ids])
        aligning = phases == Phase.ALIGN
        miss[aligning] = self._misalignment(ids[aligning], view[aligning])
        lowered = self._height_m[ids] <= self._pair.seated_z_m
        late_s[phases == Phase.INSERT] = np.where(lowered, 0.0, -1.0)[phases == Phase.INSERT]
        for phase, pace in PACES.items():
            over = (late_s >= 0) & ((miss < pace.settle_m) | (late_s >= pace.patience_s)) & (phases == phase)
            chosen = np.flatnonzero(over)
            if len(chosen):
                self._enter(ids[chosen], Phase(phase + 1), view[chosen])

    def _enter(self, ids: Ids, phase: Phase, view: View) -> None:
        self.phase[ids] = phase
        self._phase_step[ids] = 0
        self._start.assign(ids, self._wanted[ids])
        self._held.assign(ids, view.parts.inverse() @ view.hands)
        self._socket.assign(ids, view.parts[:, LEFT])
        self._entered[ids] = phase > Phase.INSERT
        if phase == Phase.INSERT:
            self._height_m[ids] = self._pair.mouth_z_m + STANDOFF_M
        if phase == Phase.CLOSE:
            self._opening[ids] = self._grip_m
        goal = self._destination(ids, phase, view)
        if self._stands:  # the hand that would hold the socket rests, open
            self._opening[ids, LEFT] = self._robot.fingers.travel_m
            goal.assign(np.s_[:, LEFT], self._wanted[ids][:, LEFT])
        self._goal.assign(ids, goal)
        pace = PACES[phase]
        way = _distance(self._start[ids], self._goal[ids], pace.turn_m_per_rad)
        if phase == Phase.INSERT:
            way = self._height_m[ids] - self._pair.seated_z_m
        self._duration[ids] = self._hz * np.maximum(way / pace.speed_m_s, pace.shortest_s)

    def _destination(self, ids: Ids, phase: Phase, view: View) -> Poses:
        """Hand poses (m, 2) in which a phase should end, as known at its beginning."""
        if phase in (Phase.REACH, Phase.APPROACH):
            along, across = np.moveaxis(self._errors.grasp_m[ids], -1, 0)
            back = RETREAT_M if phase == Phase.REACH else 0.0
            offset = np.stack([along - back, np.zeros_like(along), across], -1)
            return view.parts @ self._grasp @ Poses.from_vectors(offset, np.zeros(3))
        if phase in (Phase.LIFT, Phase.CARRY):
            stations = self._stations_now(view)
            if phase == Phase.LIFT:
                raised = view.parts.position.copy()
                raised[..., 2] = stations.position[..., 2]
                stations = Poses(raised, view.parts.rotation)
            return stations @ self._held[ids]
        goal = self._wanted[ids]
        if phase == Phase.ALIGN:
            goal.assign(np.s_[:, RIGHT], self._aligned(ids, view))
            goal.assign(np.s_[:, LEFT], _met_halfway(view) @ self._held[ids][:, LEFT])
        return goal

    def _stations_now(self, view: View) -> Poses:
        """Where parts are brought before they are aligned (m, 2): above a socket that stands, the plug."""
        stations = self._stations @ Poses.identity(len(view.q), 2)
        if self._stands:
            above = Poses.from_vectors(np.array([0.0, 0.0, self._pair.mouth_z_m + CARRY_M]), np.zeros(3))
            stations.assign(np.s_[:, RIGHT], view.parts[:, LEFT] @ above)
        return stations

    def _plan(self, ids: Ids, view: View) -> Poses:
        """Hand poses (m, 2) wanted in this control step."""
        phases, goal = self.phase[ids], self._goal[ids]
        share = np.clip(self._phase_step[ids] / self._duration[ids], 0, 1)
        aligning, inserting = phases == Phase.ALIGN, phases >= Phase.INSERT
        smooth = share * share * (3 - 2 * share)
        wanted = self._start[ids].towards(goal, np.repeat(smooth[:, None], 2, 1))
        if aligning.any():
            over = self._brought(ids[aligning], view[aligning], smooth[aligning])
            wanted.assign((aligning, RIGHT), over)
        if inserting.any():
            wanted.assign((inserting, RIGHT), self._inserted(ids[inserting], view[inserting]))
        return wanted

    def _aligned(self, ids: Ids, view: View) -> Poses:
        """Right hand (m,) that holds the plug above the mouth, from where both parts are now."""
        held = view.parts[:, RIGHT].inverse() @ view.hands[:, RIGHT]
        return (
            self._aim(ids, view.parts[:, LEFT], np.full(len(ids), self._pair.mouth_z_m + STANDOFF_M)) @ held
        )

    def _brought(self, ids: Ids, view: View, share: Array) -> Poses:
        """Right hand (m,) while it aligns: the plug's tip goes straight, so that a turn does not swing it
        into the rim.
        """
        held = view.parts[:, RIGHT].inverse() @ view.hands[:, RIGHT]
        start = self._start[ids][:, RIGHT] @ self._held[ids][:, RIGHT].inverse()
        return start.towards(self._aligned(ids, view) @ held.inverse(), share) @ held

    def _inserted(self, ids: Ids, view: View) -> Poses:
        """Right hand (m,) on the way down: corrected until the plug enters, then straight on."""
        free = ~self._entered[ids]
        self._held.assign(ids[free], view.parts[free].inverse() @ view.hands[free])
        self._socket.assign(ids[free], view.parts[free, LEFT])
        on_rim = ~free & (view.height_m > self._pair.mouth_z_m - RIM_M)
        press = np.where(on_rim, self._press_m[ids], PRESS_M)
        height = np.maximum(self._height_m[ids], view.height_m - press)
        gentle = press < PRESS_M
        self._height_m[ids[gentle]] = height[gentle]  # a plug that then slips in need not catch up with it
        return self._aim(ids, self._socket[ids], height) @ self._held[ids][:, RIGHT]

    def _descend(self, ids: Ids, view: View, moving: NDArray[np.bool_]) -> None:
        """Lower the wanted height of the plugs that are being inserted, gently at either end."""
        mouth, bottom = self._pair.mouth_z_m, self._pair.seated_z_m - BOTTOM_M
        self._entered[ids] |= (self.phase[ids] >= Phase.INSERT) & (view.height_m < mouth + ENTRY_M)
        elapsed_s = self._phase_step[ids] / self._hz
        speed = np.where(self._entered[ids], PACES[Phase.INSERT].speed_m_s, CLOSING_M_S)
        height = self._height_m[ids]
        way = np.minimum(speed / self._hz, SLOWDOWN * (height - bottom) + BOTTOM_M)
        height = np.maximum(height - way * moving * self._errors.pace[ids], bottom)
        late_s = elapsed_s - self._duration[ids] / self._hz
        wait = ~self._entered[ids] & (self._misalignment(ids, view) > READY_M) & (late_s < HOVER_S)
        self._height_m[ids] = np.where(wait, np.maximum(height, mouth + HOVER_M), height)

    def _aim(self, ids: Ids, socket: Poses, height_m: Array) -> Poses:
        """Plug poses (m,) at a height over where the sockets are believed to be."""
        lateral = self._errors.lateral_m[ids] + self._errors.tremor_m(ids, self._step[ids])
        position = np.concatenate([lateral, height_m[:, None]], 1)
        return socket @ Poses.from_vectors(position, self._errors.tilt_rad[ids])

    def _misalignment(self, ids: Ids, view: View) -> Array:
        """How far the plugs are from where they are believed to be aligned (m,) [m]."""
        height = np.full(len(ids), self._pair.mouth_z_m + STANDOFF_M)
        error = self._aim(ids, view.parts[:, LEFT], height).inverse() @ view.parts[:, RIGHT]
        lateral = np.hypot(error.position[:, 0], error.position[:, 1])
        tilt = np.linalg.norm(rotation_vector(error.rotation), axis=-1)
        return np.maximum(lateral, 0.02 * tilt)


def _met_halfway(view: View) -> Poses:
    """Sockets (m,) turned about their mouths by what is left of a plug's turn to them beyond `WRIST_RAD`."""
    sockets, plugs = view.parts[:, LEFT], view.parts[:, RIGHT]
    turn = rotation_vector(np.swapaxes(sockets.rotation, -1, -2) @ plugs.rotation)
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    rest = turn * np.maximum(1.0 - WRIST_RAD / np.maximum(angle, 1e-9), 0.0)
    return sockets @ Poses.from_vectors(np.zeros(3), rest)


def _grasps(sim: "InsertionSim") -> tuple[Poses, Array]:
    """Hands in their parts' frames (2,), and the openings commanded to hold them (2,) [m]."""
    pair, grasped, fingers = sim.scene.pair, sim.config.grasped, sim.scene.embodiment.fingers
    pitches = [grasped.left_pitch_rad, grasped.right_pitch_rad]
    raised = [0.0, 0.0]
    if sim.scene.config.start == "table":
        heights = [part.rest_height_m + part.grip.centre_m[2] for part in (pair.socket, pair.plug)]
        above = [_above_table(fingers, *item) for item in zip(pitches, heights, strict=True)]
        pitches, raised = [pitch for pitch, _ in above], [way for _, way in above]
    left = ideal_hand(pair.socket, np.pi / 2, pitches[LEFT])
    right = ideal_hand(pair.plug, -np.pi / 2, pitches[RIGHT])
    hands = Poses(np.stack([left[0], right[0]]), np.stack([left[1], right[1]]))
    hands.position[:, 2] += raised
    touching = grip_openings(pair, sim.scene.embodiment)
    return hands, np.maximum(touching - grasped.squeeze_m, 0.0)


def _above_table(fingers: Fingers, pitch_rad: float, height_m: float) -> tuple[float, float]:
    """Largest pitch up to `pitch_rad` at which the fingertips of a hand at `height_m` stay above the table.

    Where even the flattest hand is too low, the second number says how much higher it must grip [m].
    """
    length, width, _ = fingers.pad.size_m
    pitches = np.linspace(pitch_rad, min(pitch_rad, fingers.flattest_rad), 50)
    gaps = height_m - (length * np.sin(pitches) + width * np.cos(pitches)) / 2 - TABLE_GAP_M
    chosen = int(np.argmax(gaps >= 0)) if gaps[-1] >= 0 else -1
    return float(pitches[chosen]), max(0.0, -float(gaps[chosen]))


def _stations(sim: "InsertionSim") -> Poses:
    """Where parts are brought before they are aligned (2,): the socket where it stays, the plug above it."""
    mouth = np.asarray(sim.config.grasped.mouth_m)
    socket = mouth - np.array([0.0, 0.0, sim.scene.pair.mouth_z_m])
    plug = mouth + np.array([0.0, 0.0, CARRY_M])
    return Poses.from_vectors(np.stack([socket, plug]), np.zeros((2, 3)))


def _distance(start: Poses, goal: Poses, turn_m_per_rad: float = 0.1) -> Array:
    """Longer way of both hands (m,) [m], turns counted as ways."""
    way = np.linalg.norm(goal.position - start.position, axis=-1)
    turn = np.linalg.norm(rotation_vector(np.swapaxes(start.rotation, -1, -2) @ goal.rotation), axis=-1)
    return np.maximum(way, turn_m_per_rad * turn).max(-1)
