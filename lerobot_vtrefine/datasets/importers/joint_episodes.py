"""Episodes of joint commands and positions: as a LeRobotDataset, and as a recording set for diagnosis."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tqdm import tqdm

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY, Array
from lerobot_vtrefine.datasets.importers.new_folder import new_folder

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

RECORDING_SCHEMA = "vtrefine/recording-set@1"


@dataclass(frozen=True)
class JointEpisode:
    """What was commanded and what the encoders read, frame by frame; (T, J) each [rad, m]."""

    command: Array
    position: Array


def write_dataset(
    episodes: Sequence[JointEpisode], joints: Sequence[str], root: Path, repo_id: str, fps: int, task: str
) -> None:
    """Write ``observation.state`` and ``action`` as a LeRobotDataset v3; ``root`` appears when complete.

    Raises:
        FileExistsError: there is something at ``root``.
    """
    from lerobot.datasets.io_utils import SuppressProgressBars
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = list(joints)
    features = {
        key: {"dtype": "float32", "shape": (len(names),), "names": names} for key in (STATE_KEY, ACTION_KEY)
    }
    with new_folder(root) as work:
        dataset = LeRobotDataset.create(repo_id, fps, features, root=work, use_videos=False)
        try:
            for episode in tqdm(episodes, unit="episode", desc="import"):
                for command, position in zip(episode.command, episode.position, strict=True):
                    dataset.add_frame({STATE_KEY: position, ACTION_KEY: command, "task": task})
                with SuppressProgressBars():
                    dataset.save_episode()
            dataset.finalize()
        except BaseException:
            _abandon(dataset)
            raise


def _abandon(dataset: "LeRobotDataset") -> None:
    """Keep the destructors of an unfinished dataset from writing into a folder that is gone."""
    if dataset.writer is not None:
        dataset.writer._finalized = True
    dataset.meta._finalized = True


def write_recording_set(
    episodes: Sequence[JointEpisode], joints: Sequence[str], folder: Path, fps: float
) -> None:
    """Write a recording set of ``kind: robot`` (``docs/recording-format.md``), one trial per episode.

    Trials were recorded one after the other: session times add up, pauses between episodes are not known.

    Raises:
        FileExistsError: there is something at ``folder``.
    """
    with new_folder(folder) as work:
        work.mkdir()
        trials, start_s = [], 0.0
        for number, episode in enumerate(episodes):
            name = f"trial_{number:04d}.parquet"
            time_s = np.arange(len(episode.command)) / fps
            table = {"time_s": pa.array(time_s)}
            for column, values in (("command", episode.command), ("position", episode.position)):
                flat = pa.array(np.asarray(values, np.float64).ravel())
                table[column] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
            pq.write_table(pa.table(table), work / name)
            identity = {"file": name, "condition": f"c{number:02d}", "replicate": 0, "order": number}
            trials.append({**identity, "start_s": round(start_s, 6)})
            start_s += len(time_s) / fps
        content = {"schema": RECORDING_SCHEMA, "kind": "robot", "joints": list(joints), "trials": trials}
        (work / "recording.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
