"""What the task remembers of each world's episode, and how one control step changes it.

Shapes: N worlds, m of them addressed; parts are ordered socket, plug; P pads.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from lerobot_vtrefine.sim import task
from lerobot_vtrefine.sim.backends.base import LOAD_SIZE
from lerobot_vtrefine.sim.config import LimitsConfig, SuccessConfig, TaskConfig
from lerobot_vtrefine.sim.scene import Scene
from lerobot_vtrefine.sim.substeps import Substeps

Array = np.ndarray

GRASP_SETTLE_S = 0.3
"""A part must have been held for so long before its place in the hand becomes the reference."""
LIFT_M = 0.01
"""A part this much above its resting height has been lifted."""
WORKSPACE_M = (0.35, 0.4, 0.6)
"""A part outside |x|, |y|, z of this box, or below the table, is lost."""


@dataclass
class EpisodeState:
    """One row per world; rows are copied as a whole by snapshots."""

    seed: Array
    steps: Array
    """Control steps done."""
    force_limit: Array
    """(N,) contact force that ends the episode [N]."""
    command: Array
    """(N, nu) servo command at the end of the last control step."""
    hold_steps: Array
    """Control steps for which the plug has been seated without interruption."""
    held_steps: Array
    """(N, part) control steps for which the part has been held without interruption."""
    unheld_steps: Array
    """(N, part) control steps for which a lifted part has not been held."""
    grasped: Array
    """(N, part) whether `reference` holds."""
    lifted: Array
    """(N, part) whether the part is well above the height at which it rests."""
    picked_up: Array
    """(N,) whether at some moment all parts that hands are to take were grasped and lifted."""
    reference: Array
    """(N, part, 2, 3) grip points in the hand's frame at the grasp."""
    shift: Array
    """(N, part) displacement since the grasp [m]."""
    largest_shift: Array
    """(N, part) largest so far."""
    force_tail: Array
    """(N, w - 1, 3) last contact forces, for the moving average."""
    part_force: Array
    """(N, 3) force of the plug on the socket at the last substep, world frame [N]."""
    touch: Array
    """(N, 4) whether the parts touch at the last substep, 0 or 1, and where, in the socket's frame [m]."""
    pad_force: Array
    """(N, P) normal force on each pad at the last substep [N]."""
    pad_load: Array
    """(N, P, LOAD_SIZE) what the solver says of each pad."""
    step_force: Array
    """(N,) peak of the averaged contact force in the last control step [N]."""
    peak_force: Array
    """(N,) the same over the episode."""
    rim_slide: Array
    tip: Array
    """(N, 3) plug's origin in the socket's frame."""
    failure: Array
    """Index into `task.FAILURES`."""
    success: Array
    done: Array
    success_step: Array
    """Control step at which success was reached, -1 before."""

    @classmethod
    def empty(cls, scene: Scene, num_envs: int, window: int) -> "EpisodeState":
        """All zeros for `num_envs` worlds of a scene and a force window of `window` samples."""
        n, pads = num_envs, len(scene.embodiment.pad_names)
        shapes: dict[str, tuple[tuple[int, ...], type]] = {
            "seed": ((n,), np.int64),
            "steps": ((n,), np.int64),
            "force_limit": ((n,), float),
            "command": ((n, scene.model.nu), float),
            "hold_steps": ((n,), np.int64),
            "held_steps": ((n, 2), np.int64),
            "unheld_steps": ((n, 2), np.int64),
            "grasped": ((n, 2), bool),
            "lifted": ((n, 2), bool),
            "picked_up": ((n,), bool),
            "reference": ((n, 2, 2, 3), float),
            "shift": ((n, 2), float),
            "largest_shift": ((n, 2), float),
            "force_tail": ((n, window - 1, 3), float),
            "part_force": ((n, 3), float),
            "touch": ((n, 4), float),
            "pad_force": ((n, pads), float),
            "pad_load": ((n, pads, LOAD_SIZE), float),
            "step_force": ((n,), float),
            "peak_force": ((n,), float),
            "rim_slide": ((n,), float),
            "tip": ((n, 3), float),
            "failure": ((n,), np.int64),
            "success": ((n,), bool),
            "done": ((n,), bool),
            "success_step": ((n,), np.int64),
        }
        return cls(**{name: np.zeros(shape, kind) for name, (shape, kind) in shapes.items()})

    def clear(self, ids: Array) -> None:
        """Zero the rows of `ids`."""
        for item in fields(self):
            getattr(self, item.name)[ids] = 0
        self.success_step[ids] = -1

    def moments(self, ids: Array, after: Array | None = None) -> Array:
        """(m, 2) int64 seed and control step of worlds `ids`, once the worlds `after` have done one more."""
        more = 0 if after is None else np.isin(ids, after)
        return np.stack([self.seed[ids], self.steps[ids] + more], 1)

    def limits(self, ids: Array, config: LimitsConfig) -> Array:
        """(m, 2) float32 what ends the episodes of worlds `ids`: contact force [N], shift in the hand [m]."""
        force = self.force_limit[ids]
        return np.stack([force, np.full_like(force, config.in_hand_shift_m)], 1).astype(np.float32)

    def seated_s(self, dt_s: float) -> Array:
        """(N,) for how long each plug has been seen seated at every control step; NaN where it is not."""
        return np.where(self.hold_steps > 0, (self.hold_steps - 1) * dt_s, np.nan)

    def metrics(self, ids: Array, dt_s: float) -> dict[str, Array]:
        """How the episodes of worlds `ids` went so far, (m,) each; no success has time NaN."""
        steps = np.where(self.success[ids], self.success_step[ids], np.nan)
        return {
            "success": self.success[ids],
            "failure": self.failure[ids],
            "picked_up": self.picked_up[ids],
            "in_hand_shift_m": self.largest_shift[ids].max(1),
            "rim_slide_m": self.rim_slide[ids],
            "peak_force_n": self.peak_force[ids],
            "time_to_success_s": steps * dt_s,
        }

    def row(self, env: int) -> dict[str, Array]:
        """A copy of one world's row."""
        return {item.name: getattr(self, item.name)[env].copy() for item in fields(self)}

    def set_row(self, env: int | Array, row: dict[str, Array]) -> None:
        """Write back a row taken by `row`; of several worlds (m,), rows (m, ...)."""
        for name, value in row.items():
            getattr(self, name)[env] = value


@dataclass(frozen=True)
class Measured:
    """What one control step of m worlds showed."""

    insertion: task.Insertion
    grip_points: Array
    """(m, part, 2, 3) [m]"""
    part_heights: Array
    """(m, part) height of each part's origin above its resting height [m]."""
    part_positions: Array
    """(m, part, 3)"""
    substeps: Substeps
    pad_load: Array
    """(m, P, LOAD_SIZE)"""
    diverged: Array
    """(m,) whether the state blew up: everything else then means nothing and may be NaN."""
    overflowed: Array
    """(m,) whether contacts were lost for want of room."""

    def checked(self) -> "Measured":
        """The same, with zeros for the forces of worlds that blew up, and those whose forces are NaN
        among them: what an episode remembers stays finite.
        """
        forces = {item.name: getattr(self.substeps, item.name) for item in fields(self.substeps)}
        finite = [np.isfinite(values).reshape(len(values), -1).all(1) for values in forces.values()]
        finite.append(np.isfinite(self.pad_load).all((1, 2)))
        bad = self.diverged | ~np.logical_and.reduce(finite)
        quiet = {name: _without(values, bad) for name, values in forces.items()}
        return replace(self, substeps=Substeps(**quiet), pad_load=_without(self.pad_load, bad), diverged=bad)


def _without(values: Array, bad: Array) -> Array:
    return np.where(bad.reshape(-1, *[1] * (values.ndim - 1)), 0.0, values)


def update(state: EpisodeState, ids: Array, seen: Measured, config: TaskConfig, scene: Scene) -> Array:
    """Advance the episodes of `ids` by one control step.

    Returns:
        (m,) reward: 1 in the step in which success is reached, else 0.
    """
    state.steps[ids] += 1
    seen = seen.checked()
    _update_forces(state, ids, seen)
    state.rim_slide[ids] += seen.substeps.rim_slide
    state.tip[ids] = seen.substeps.tip
    _update_grasp(state, ids, seen, scene, config.control_dt_s)
    fresh = _update_success(state, ids, seen, config.success, config.control_dt_s)
    _update_failure(state, ids, seen, config.limits, config.control_dt_s)
    state.done[ids] |= state.success[ids] | (state.failure[ids] != task.NO_FAILURE)
    return (fresh & (state.failure[ids] == task.NO_FAILURE)).astype(np.float64)


def _update_forces(state: EpisodeState, ids: Array, seen: Measured) -> None:
    peak = seen.substeps.force_peak
    state.force_tail[ids], state.step_force[ids] = seen.substeps.force_tail, peak
    state.peak_force[ids] = np.maximum(state.peak_force[ids], peak)
    state.part_force[ids], state.touch[ids] = seen.substeps.force, seen.substeps.touch
    state.pad_load[ids], state.pad_force[ids] = seen.pad_load, seen.pad_load[..., 0]


def _update_grasp(state: EpisodeState, ids: Array, seen: Measured, scene: Scene, dt_s: float) -> None:
    """Take each part's reference once its own hand has held it long enough; a part set down again loses it.

    From then on the shift counts, also while the part is being lifted: starts in hand begin with a reference.
    """
    held = task.held_parts(scene.holders, scene.embodiment.num_arms, state.pad_force[ids])
    state.lifted[ids] = lifted = seen.part_heights > LIFT_M
    state.held_steps[ids] = np.where(held, state.held_steps[ids] + 1, 0)
    state.unheld_steps[ids] = np.where(held | ~lifted, 0, state.unheld_steps[ids] + 1)
    grasped = state.grasped[ids]
    starts = ~grasped & (state.held_steps[ids] >= max(1, round(GRASP_SETTLE_S / dt_s)))
    state.reference[ids] = np.where(starts[..., None, None], seen.grip_points, state.reference[ids])
    set_down = grasped & ~held & ~lifted
    grasped = (grasped | starts) & ~set_down
    state.grasped[ids] = grasped
    state.picked_up[ids] |= in_hand(scene, grasped & lifted)
    shift = np.where(grasped, task.in_hand_shift(seen.grip_points, state.reference[ids]), 0.0)
    state.shift[ids] = shift
    state.largest_shift[ids] = np.maximum(state.largest_shift[ids], shift)


def in_hand(scene: Scene, held: Array) -> Array:
    """(m,) whether all parts that hands are to take are among those `held` (m, part)."""
    taken = [arm is not None for arm in scene.holders]
    return np.all(held[:, taken], axis=1)


def _update_success(
    state: EpisodeState, ids: Array, seen: Measured, config: SuccessConfig, dt_s: float
) -> Array:
    seated = task.is_seated(seen.insertion, config)
    state.hold_steps[ids] = np.where(seated, state.hold_steps[ids] + 1, 0)
    fresh = (state.hold_steps[ids] >= config.hold_steps(dt_s)) & ~state.done[ids]
    state.success[ids] |= fresh
    state.success_step[ids] = np.where(fresh, state.steps[ids], state.success_step[ids])
    return fresh


def _update_failure(
    state: EpisodeState, ids: Array, seen: Measured, config: LimitsConfig, dt_s: float
) -> None:
    position = seen.part_positions
    lost = (np.abs(position[..., 0]) > WORKSPACE_M[0]) | (np.abs(position[..., 1]) > WORKSPACE_M[1])
    lost |= (position[..., 2] > WORKSPACE_M[2]) | (seen.part_heights < -0.02)
    dropped = state.unheld_steps[ids] * dt_s >= config.drop_s
    causes = (
        (task.UNSTABLE, seen.diverged),
        (task.OVERFLOWED, seen.overflowed),
        (task.SHIFTED, (state.shift[ids] > config.in_hand_shift_m).any(1)),
        (task.FORCED, state.step_force[ids] > state.force_limit[ids]),
        (task.DROPPED, (dropped | lost).any(1)),
    )
    failure = state.failure[ids]
    for code, happened in causes:
        failure = np.where((failure == task.NO_FAILURE) & happened & ~state.done[ids], code, failure)
    state.failure[ids] = failure
    failed = failure != task.NO_FAILURE
    state.success[ids] &= ~failed
    state.success_step[ids] = np.where(failed, -1, state.success_step[ids])
