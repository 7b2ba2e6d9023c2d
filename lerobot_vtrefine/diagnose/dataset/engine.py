"""A dataset's robot against the MuJoCo twin, then its parts and its camera, one after the other.

Where a dataset notes the scene that it was thought to show, robot and parts are judged by replay through the
twin; what the robot does beyond the twin is taken off before the parts are judged, and the parts' weight is
known before the robot is. Other datasets have their joints judged by plain servos: no part and no clamp of
their commands is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.datasets.episodes import open_episodes
from lerobot_vtrefine.diagnose.camera.engine import diagnose_camera
from lerobot_vtrefine.diagnose.camera.frames import has_depth
from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.engine import Progress
from lerobot_vtrefine.diagnose.evidence import not_tested
from lerobot_vtrefine.diagnose.joints.dataset import episode_name
from lerobot_vtrefine.diagnose.joints.engine import diagnose_robot
from lerobot_vtrefine.diagnose.joints.model import RobotModel
from lerobot_vtrefine.diagnose.joints.twin_diagnosis import TwinTrial, beyond_twin, diagnose_on_twin
from lerobot_vtrefine.diagnose.parts.engine import (
    assumed_masses,
    diagnose_parts,
    masses_kg,
    unknown_parts,
    weigh,
)
from lerobot_vtrefine.diagnose.parts.episodes import (
    AssumedScene,
    HandledEpisode,
    assumed_scene,
    lately,
    read_episodes,
)
from lerobot_vtrefine.diagnose.parts.payload import given, replay_loaded
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.verdict import Status

Array = np.ndarray

BUMP_RAD = 5e-5
"""The twin with and without contacts differ by so much only where a hand meets the table or the other one."""
_RECOVERS_S = 0.6
WEIGHT_KNOWN = 0.05
"""Part of what the carried weight does to the joints that may be wrong without the robot being so."""
_WORSE: tuple[Status, ...] = ("adequate", "explained", "ambiguous", "unexplained")
"""From best to worst."""


def diagnose_dataset(recordings: RecordingSet, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """Judge a dataset; `recordings` are its episodes after quality control.

    Raises:
        ValueError: commands that are not finite, or a note of the assumed scene that is damaged or names
            another robot.
    """
    tell = progress or (lambda text, done: None)
    scene = assumed_scene(open_episodes(recordings.path))
    if scene is None:
        found, objects = diagnose_robot(recordings, seed, progress), unknown_parts()
    else:
        _check_joints(recordings, scene)
        found, objects = _on_twin(recordings, scene, seed, progress)
    found = merged(found, objects)
    if not has_depth(recordings.path):
        return found
    tell("camera: comparing depth images", 0.9)
    return merged(found, diagnose_camera(recordings.path, seed, progress))


def merged(robot: Diagnosis, other: Diagnosis) -> Diagnosis:
    """The robot's diagnosis with other causes beside its own.

    Held-out errors are those of the joints where something was found about these, else those of what was
    found; every cause's own gain stands with it. An alarm about joints says nothing about a camera, but a
    verdict that is unexplained holds symptoms only.
    """
    one, two = robot.verdict, other.verdict
    if two.causes and one.status == "adequate":
        robot = replace(robot, trial_errors=other.trial_errors, unit=other.unit, traces=(), residuals=())
        one = replace(one, heldout=two.heldout)
    unknown = max(one.unknown, two.unknown, key=lambda item: (item.alarm, bool(item.clue)))
    causes = [
        replace(cause, role="symptom") if unknown.alarm else cause for cause in (*one.causes, *two.causes)
    ]
    evidence = [
        replace(item, decision="symptom") if unknown.alarm and item.decision == "accepted" else item
        for item in (*robot.evidence, *other.evidence)
    ]
    verdict = replace(
        one,
        status=max(one.status, two.status, key=_WORSE.index),
        causes=tuple(causes),
        ambiguous_with=() if unknown.alarm else (*one.ambiguous_with, *two.ambiguous_with),
        unknown=unknown,
        minimum_detectable={**one.minimum_detectable, **two.minimum_detectable},
        next_experiment=one.next_experiment or two.next_experiment,
        not_tested=not_tested(evidence),
    )
    return replace(robot, verdict=verdict, evidence=tuple(evidence))


@dataclass(frozen=True)
class _Session:
    """What robot and parts are judged from."""

    recordings: RecordingSet
    scene: AssumedScene
    episodes: tuple[HandledEpisode, ...]

    def twin(self, mass_kg: Array) -> dict[str, TwinTrial]:
        """What the twin does in every episode with parts of those masses (2,)."""
        weights = self.scene.weights_n(self.episodes, mass_kg)
        touching, free = (
            replay_loaded(self.scene, self.episodes, weights, contacts=contacts) for contacts in (True, False)
        )
        frames = max(1, round(_RECOVERS_S / self.scene.rules.control_dt_s))
        out = {}
        for episode, path, other in zip(self.episodes, touching, free, strict=True):
            bumped = lately((np.abs(path - other).max(1) > BUMP_RAD)[:, None], frames)[:, 0]
            usable = (episode.free | episode.carried).all(1) & ~bumped
            out[episode_name(episode.index)] = TwinTrial(given(self.scene, episode), path, usable)
        return out


def _check_joints(recordings: RecordingSet, scene: AssumedScene) -> None:
    """Raises: ValueError for another robot than the assumed scene's."""
    if recordings.joints != scene.body.joint_names:
        raise ValueError(
            f"{recordings.path}: its note names the robot {scene.body.name}, but its joints are "
            f"{', '.join(recordings.joints)}"
        )


def _on_twin(
    recordings: RecordingSet, scene: AssumedScene, seed: int, progress: Progress | None
) -> tuple[Diagnosis, Diagnosis]:
    kept = {trial.file for trial in recordings.trials}
    episodes = read_episodes(recordings.path, scene)
    episodes = tuple(item for item in episodes if episode_name(item.index) in kept)
    session = _Session(recordings, scene, episodes)
    mass = masses_kg(weigh(scene, episodes, seed))
    found = _robot(session, mass, seed, progress)
    trusted = _corrected(session, found, mass)
    weighed = weigh(scene, trusted, seed)
    objects, now = diagnose_parts(scene, trusted, weighed, seed), masses_kg(weighed)
    if np.abs(now - mass).max() > 0.1 * assumed_masses(scene).min():
        found = _robot(session, now, seed, progress)
    return found, objects


def _robot(session: _Session, mass_kg: Array, seed: int, progress: Progress | None) -> Diagnosis:
    twin, empty = session.twin(mass_kg), session.twin(np.zeros(2))
    bent = [np.abs(one.path - empty[name].path)[one.usable] for name, one in twin.items()]
    floor = WEIGHT_KNOWN * max(float(np.max(item, initial=0.0)) for item in bent)
    return diagnose_on_twin(session.recordings, twin, session.scene.scene, seed, floor, progress)


def _corrected(session: _Session, found: Diagnosis, mass_kg: Array) -> Sequence[HandledEpisode]:
    """Episodes as the twin's own encoders would have read them, had the robot none of what was found."""
    twin = session.twin(mass_kg)
    assert isinstance(found.extended_model, RobotModel)
    more = beyond_twin(session.recordings, twin, session.scene.scene, found.extended_model)
    return [
        replace(episode, position=episode.position - more[episode_name(episode.index)])
        for episode in session.episodes
    ]
