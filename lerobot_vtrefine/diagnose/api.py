"""The library's door: measured recordings in, what the simulation gets wrong out.

    from lerobot_vtrefine.diagnose.api import diagnose

    found = diagnose("presses")
    print(found.verdict.status, [cause.name for cause in found.verdict.causes])
    found.extended_model.save("sensor_model.json")

``vtrefine-diagnose`` writes what `diagnose` returns, and ``scripts/bench_diagnose.py`` grades it.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.evidence import Savable
from lerobot_vtrefine.diagnose.joints.dataset import read_dataset
from lerobot_vtrefine.diagnose.joints.model import RobotModel
from lerobot_vtrefine.diagnose.quality import check_quality, too_little
from lerobot_vtrefine.diagnose.recordings import RecordingSet, read_recording_set
from lerobot_vtrefine.diagnose.servo.bench import on_bench
from lerobot_vtrefine.diagnose.servo.model import ServoModel
from lerobot_vtrefine.diagnose.verdict import Verdict
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.readout import Gain, Idle, Quantisation

__all__ = ["Diagnosis", "Rooted", "diagnose", "read_recordings"]

Progress = Callable[[str, float], None]


class Rooted(Protocol):
    """A LeRobot dataset, as far as it is needed: the folder that it lies in."""

    @property
    def root(self) -> str | Path:
        """Holds ``meta/info.json``."""
        ...


def diagnose(
    source: str | Path | RecordingSet | Rooted, seed: int = 0, progress: Progress | None = None
) -> Diagnosis:
    """Quality control and diagnosis.

    Args:
        source: a folder with ``recording.json``, a LeRobot dataset or its folder (one episode is one trial),
            or recordings that were read already.
        seed: of resampling and of what is locked away.
        progress: called with what is being done and the fraction done.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: recordings that cannot be read; names the file, trial and column.
    """
    recordings = source if isinstance(source, RecordingSet) else read_recordings(source)
    sound, issues = check_quality(recordings)
    hopeless = too_little(sound, recordings)
    if hopeless is None:
        found = _judged(sound, seed, progress)
    else:
        unit = "counts" if recordings.kind == "pad" else "rad"
        found = Diagnosis(Verdict("invalid_data", data_issues=(hopeless,)), unit=unit)
    return replace(
        found.noting(*issues),
        baseline_model=found.baseline_model or _unfitted_model(recordings),
        extended_model=found.extended_model or _unfitted_model(recordings),
        checked=len(sound.trials),
    )


def read_recordings(source: str | Path | Rooted) -> RecordingSet:
    """The recordings in a folder, of either kind; errors as for `diagnose`."""
    folder = Path(source if isinstance(source, str | Path) else source.root)
    if (folder / "meta" / "info.json").is_file():
        return read_dataset(root=folder)
    return read_recording_set(folder)


def _judged(sound: RecordingSet, seed: int, progress: Progress | None) -> Diagnosis:
    """By the instrument that the recordings are of."""
    if sound.kind == "pad":
        from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad

        return diagnose_pad(sound, seed, progress)
    if (sound.path / "meta" / "info.json").is_file():
        from lerobot_vtrefine.diagnose.dataset.engine import diagnose_dataset

        return diagnose_dataset(sound, seed, progress)
    if on_bench(sound):
        from lerobot_vtrefine.diagnose.servo.engine import diagnose_servo

        return diagnose_servo(sound, seed, progress)
    from lerobot_vtrefine.diagnose.joints.engine import diagnose_robot

    return diagnose_robot(sound, seed, progress)


def _unfitted_model(recordings: RecordingSet) -> Savable:
    """What the simulation assumes before anything is fitted, for data that allow no fit."""
    if on_bench(recordings):
        return ServoModel.default()
    if recordings.kind == "robot":
        return RobotModel.default(recordings.joints)
    converter = Quantisation(full_scale_counts=recordings.full_scale)
    return SensorModel((KelvinVoigt(), Gain(), Idle(spread_counts=0.0), converter))
