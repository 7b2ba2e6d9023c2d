"""A robot judged against its MuJoCo twin, where there is one, in place of plain servos.

Two replays of the commands differ in what is known and does not depend on the robot's faults: one has
fine steps, the table and the weight of the parts that are carried, the other coarse steps and nothing around.
Their difference is taken from the recorded positions; the engine then replays the coarse one under each fault
that it tries (`twin_problem`). What it settles on is refitted in fine steps: coarse ones are off by a few per
cent of a delay or a play.

Shapes: T frames, J joints.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.engine import Progress
from lerobot_vtrefine.diagnose.evidence import Trace
from lerobot_vtrefine.diagnose.joints.batch import make_batch
from lerobot_vtrefine.diagnose.joints.engine import diagnose_problem
from lerobot_vtrefine.diagnose.joints.model import RobotModel, from_model
from lerobot_vtrefine.diagnose.joints.twin_problem import COARSE_S, FINE_S, NOMINAL, TwinProblem
from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial
from lerobot_vtrefine.diagnose.verdict import Parameter
from lerobot_vtrefine.embodiments import Embodiment, get_embodiment
from lerobot_vtrefine.sim.config import SceneConfig

Array = np.ndarray


@dataclass(frozen=True)
class TwinTrial:
    """What the whole twin did in one trial."""

    command: Array
    """(T, J) that it was given: recorded ones, but fingers stand where the recorded ones hold something."""
    path: Array
    """(T, J) its positions."""
    usable: Array
    """(T,) bool: frames that say something about the robot; others have contacts that the twin lacks."""


def diagnose_on_twin(
    recordings: RecordingSet,
    twin: Mapping[str, TwinTrial],
    config: SceneConfig,
    seed: int = 0,
    floor: float = 0.0,
    progress: Progress | None = None,
) -> Diagnosis:
    """As `diagnose_robot`, against what the twin did (by trial file).

    Args:
        floor: what the twin itself may be wrong by [rad]; smaller effects get no name.

    Raises:
        KeyError: a trial that the twin did not follow.
    """
    problem, _ = posed(recordings, twin, config, COARSE_S)
    fine, extra = posed(recordings, twin, config, FINE_S)
    problem = replace(problem, fine=fine, floor=max(problem.floor, floor))
    found = diagnose_problem(problem, seed, progress)
    traces = tuple(_absolute(trace, recordings.joints, extra, twin) for trace in found.traces)
    return replace(found, traces=traces, baseline_params=_servos(found, get_embodiment(config.embodiment)))


def posed(
    recordings: RecordingSet, twin: Mapping[str, TwinTrial], config: SceneConfig, step_s: float
) -> tuple[TwinProblem, dict[str, Array]]:
    """The problem in steps of that length; by trial file (T, J) that was taken from the positions for it."""
    extra = beyond_bare(recordings, twin, config, step_s)
    trials = [_relative(trial, twin[trial.file], extra[trial.file]) for trial in recordings.trials]
    return TwinProblem.on(recordings.joints, make_batch(trials), config, step_s), extra


def beyond_bare(
    recordings: RecordingSet, twin: Mapping[str, TwinTrial], config: SceneConfig, step_s: float
) -> dict[str, Array]:
    """By trial file: (T, J) that the whole twin does beyond the bare arms in steps of that length."""
    copies = [replace(t, command=twin[t.file].command, position=twin[t.file].path) for t in recordings.trials]
    problem = TwinProblem.on(recordings.joints, make_batch(copies), config, step_s)
    left = problem.residual(problem.predict(problem.start()))
    return {trial.file: left[: len(trial.time_s), k] for k, trial in enumerate(copies)}


def beyond_twin(
    recordings: RecordingSet, twin: Mapping[str, TwinTrial], config: SceneConfig, model: RobotModel
) -> dict[str, Array]:
    """By trial file: (T, J) that a model found by `diagnose_on_twin` adds to the twin."""
    trials = [replace(trial, command=twin[trial.file].command) for trial in recordings.trials]
    problem = TwinProblem.on(recordings.joints, make_batch(trials), config, FINE_S)
    more = problem.predict(from_model(model)) - problem.predict(problem.start())
    return {trial.file: more[: len(trial.time_s), k] for k, trial in enumerate(trials)}


def _relative(trial: RobotTrial, twin: TwinTrial, extra: Array) -> RobotTrial:
    """The first frame stays usable: predictions start there."""
    usable = twin.usable.copy()
    usable[0] = True
    position = np.where(usable[:, None], trial.position - extra, np.nan)
    return replace(trial, command=twin.command, position=position)


def _absolute(
    trace: Trace, joints: tuple[str, ...], extra: Mapping[str, Array], twin: Mapping[str, TwinTrial]
) -> Trace:
    """Positions as they were recorded and as the whole twin predicts them."""
    used = twin[trace.file].usable.copy()
    used[0] = True
    more = extra[trace.file][used][:, [joints.index(name) for name in trace.channels]]
    shifted = [values + more for values in (trace.measured, trace.simulated, trace.extended)]
    return replace(trace, measured=shifted[0], simulated=shifted[1], extended=shifted[2])


def _servos(found: Diagnosis, body: Embodiment) -> dict[str, Parameter]:
    """The refitted servo gains and dampings of the twin's revolute joints."""
    out: dict[str, Parameter] = {}
    assert isinstance(found.baseline_model, RobotModel)
    for joint in found.baseline_model.joints:
        known = body.joint_of(joint.name)
        if known is None:
            continue
        speed = joint.natural_frequency_rad_s / NOMINAL[0]
        damping = known.damping * speed * joint.damping_ratio / NOMINAL[1]
        out[f"{joint.name}.stiffness"] = Parameter(known.stiffness * speed**2, None, "N*m/rad")
        out[f"{joint.name}.damping"] = Parameter(damping, None, "N*m*s/rad")
    return out
