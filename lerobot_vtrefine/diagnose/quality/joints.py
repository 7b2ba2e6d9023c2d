"""Checks of robot recordings: encoders that stick, or that belong to another joint."""

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from lerobot_vtrefine.diagnose.joints.batch import coarse_gaps
from lerobot_vtrefine.diagnose.joints.rules import OFF_LATTICE
from lerobot_vtrefine.diagnose.quality.edits import KEPT, SET_ASIDE, Finding
from lerobot_vtrefine.diagnose.quality.rules import (
    BETTER_ORDER,
    COARSE_RAD,
    EXCHANGED,
    JUMP_RAD,
    MINORITY,
    MOVES,
    STILL,
    SWAP_SHOWS,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial


def check_encoders(recordings: RecordingSet) -> Iterator[Finding]:
    """Encoders that do not move with their command although the command moves."""
    command = np.array([np.ptp(trial.command, axis=0) for trial in recordings.trials])
    position = np.array([np.ptp(trial.position, axis=0) for trial in recordings.trials])
    moves = command > np.maximum(MOVES * command.max(axis=0), 1e-9)
    stuck = moves & (position < STILL * command)
    always = stuck.sum(axis=0) > MINORITY * np.maximum(moves.sum(axis=0), 1)
    for joint in np.flatnonzero(always):
        problem = (
            f"position of {recordings.joints[joint]} stays constant in most trials while its command moves"
        )
        yield Finding(None, problem, f"{KEPT}: this joint cannot be judged")
    for index in np.flatnonzero((stuck & ~always).any(axis=1)):
        names = [recordings.joints[joint] for joint in np.flatnonzero(stuck[index] & ~always)]
        yield Finding(int(index), f"position stays constant: {', '.join(names)}", SET_ASIDE)


def check_steps(recordings: RecordingSet) -> Iterator[Finding]:
    """Encoders whose readings come in steps that hide what arms usually lack."""
    for joint, name in enumerate(recordings.joints):
        gaps = coarse_gaps(np.concatenate([trial.position[:, joint] for trial in recordings.trials]))
        if not len(gaps) or (step := float(np.median(gaps))) < COARSE_RAD:
            continue
        if np.abs(gaps / step - np.round(gaps / step)).max() < OFF_LATTICE:
            yield Finding(
                None, f"position of {name} comes in steps of {step:.3g}", f"{KEPT}: half a step is not judged"
            )


def check_jumps(recordings: RecordingSet) -> Iterator[Finding]:
    """Encoders that jump where their command does not: lost turns, corrupted frames."""
    for index, trial in enumerate(recordings.trials):
        step = np.abs(np.diff(trial.position, axis=0)).max(axis=0, initial=0.0)
        commanded = np.ptp(trial.command, axis=0)
        jumps = (step > JUMP_RAD) & (step > commanded)
        if jumps.any():
            names = ", ".join(recordings.joints[joint] for joint in np.flatnonzero(jumps))
            problem = f"position jumps by {step[jumps].max():.3g} in one frame: {names}"
            yield Finding(index, problem, SET_ASIDE)


def check_commands(recordings: RecordingSet) -> Iterator[Finding]:
    """Commands that stay constant in a trial although the joint moves as far as in others."""
    command = np.array([np.ptp(trial.command, axis=0) for trial in recordings.trials])
    position = np.array([np.ptp(trial.position, axis=0) for trial in recordings.trials])
    still = (command < STILL * position) & (position > MOVES * command.max(axis=0))
    still &= command.max(axis=0) > 0
    for index in np.flatnonzero(still.any(axis=1)):
        names = ", ".join(recordings.joints[joint] for joint in np.flatnonzero(still[index]))
        yield Finding(int(index), f"command stays constant while the joint moves: {names}", SET_ASIDE)


def check_joint_order(recordings: RecordingSet) -> Iterator[Finding]:
    """Positions that follow another joint's command better than their own."""
    found = {
        index: names
        for index, trial in enumerate(recordings.trials)
        if (names := _exchanged(trial, recordings))
    }
    if len(found) > MINORITY * len(recordings.trials):
        problem = f"positions of {found[min(found)]} are swapped in most trials"
        yield Finding(None, problem, f"{KEPT}: check the order of the joints")
        return
    for index, names in found.items():
        yield Finding(index, f"positions of {names} are swapped", SET_ASIDE)


def _exchanged(trial: RobotTrial, recordings: RecordingSet) -> str | None:
    """Names of joints whose encoders are swapped in a trial, or None."""
    command, position = trial.command, trial.position
    joints = np.flatnonzero((np.ptp(command, axis=0) > SWAP_SHOWS) & (np.ptp(position, axis=0) > 1e-6))
    if len(joints) < 2:
        return None
    normal = [values[:, joints] - values[:, joints].mean(axis=0) for values in (position, command)]
    normal = [values / np.linalg.norm(values, axis=0) for values in normal]
    cost = 1.0 - normal[0].T @ normal[1]
    _, order = linear_sum_assignment(cost)
    moved = np.flatnonzero(order != np.arange(len(joints)))
    if len(moved) == 0:
        return None
    own, other = np.diag(cost)[moved].mean(), cost[moved, order[moved]].mean()
    if own < EXCHANGED or other > BETTER_ORDER * own:
        return None
    return " and ".join(recordings.joints[joint] for joint in joints[moved])
