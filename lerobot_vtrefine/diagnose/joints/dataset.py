"""A LeRobot dataset as robot recordings: one episode is one trial."""

import os
from pathlib import Path

from huggingface_hub.constants import HF_HOME

from lerobot_vtrefine.datasets.episodes import EpisodeFolder, open_episodes
from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial

PAUSE_S = 20.0
"""Taken between episodes: datasets do not note when an episode was recorded."""


def dataset_root(repo_id: str | None, root: str | Path | None) -> Path:
    """Where a dataset lies on this machine; nothing is downloaded.

    Raises ValueError if neither is given, FileNotFoundError where the dataset is not there.
    """
    if root is None and repo_id is None:
        raise ValueError("give --dataset.root or --dataset.repo_id")
    home = Path(os.environ.get("HF_LEROBOT_HOME", Path(HF_HOME) / "lerobot"))
    found = Path(root) if root is not None else home / str(repo_id)
    if not (found / "meta" / "info.json").is_file():
        hint = "" if root is not None else "; datasets are not downloaded here, give --dataset.root"
        raise FileNotFoundError(f"{found} holds no LeRobot dataset (no meta/info.json){hint}")
    return found


def read_dataset(repo_id: str | None = None, root: str | Path | None = None) -> RecordingSet:
    """Actions and joint positions of every episode, as a set of kind "robot".

    Joints without names are numbered, unless the robot type tells them. Episodes follow one another with
    `PAUSE_S` between them.

    Raises:
        FileNotFoundError: no dataset there.
        ValueError: it lacks `action` or `observation.state`, or their shapes differ; names the file.
    """
    folder = open_episodes(dataset_root(repo_id, root))
    names = joint_names(folder)
    trials, start_s = [], 0.0
    for episode in folder.read():
        time_s = episode.time_s.astype(float) - float(episode.time_s[0])
        trials.append(
            RobotTrial(
                file=episode_name(episode.index),
                condition=f"episode {episode.index}",
                order=episode.index,
                start_s=start_s,
                time_s=time_s,
                command=episode.action,
                position=episode.state,
                load=None,
            )
        )
        start_s += float(time_s[-1]) + PAUSE_S
    return RecordingSet(folder.root, "robot", 0, 0, 0.0, 0.0, names, tuple(trials))


def episode_name(index: int) -> str:
    """An episode's name as a trial."""
    return f"episode_{index:06d}"


def joint_names(folder: EpisodeFolder) -> tuple[str, ...]:
    """Names of the columns of state and action."""
    if folder.joints:
        return tuple(name.removesuffix(".pos") for name in folder.joints)
    return tuple(f"joint_{index}" for index in range(folder.num_joints))
