"""``vtrefine-import``: turn datasets of others into LeRobotDatasets with this project's features.

examples:
  vtrefine-import --source=aloha_31_episodes.npz --root=outputs/aloha        # the VT-Refine authors' file
  vtrefine-import --source=LEFLEXITAC_DATASET --root=outputs/pads --pads='{primary: left_arm_left_finger}'
  vtrefine-import --source=bam_xl330.npz --recording_dir=outputs/xl330        # BAM's logs of a servo
"""

import logging
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs import parser
from lerobot.utils.utils import init_logging

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.datasets.features import joint_keys
from lerobot_vtrefine.datasets.importers.aloha_npz import read_aloha_npz
from lerobot_vtrefine.datasets.importers.bam_logs import is_bam, read_bam, write_bam
from lerobot_vtrefine.datasets.importers.joint_episodes import write_dataset, write_recording_set
from lerobot_vtrefine.datasets.importers.leflexitac import import_leflexitac, is_leflexitac
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.wording import plural

FORMATS = (
    "the paper authors' .npz of commands and positions, a LeRobot v3 folder with LeFlexiTac's pads, or BAM's "
    "logs of a servo (.npz, or a folder of .json)"
)


@dataclass
class ImportConfig:
    """Flags of ``vtrefine-import``."""

    source: Path
    """File or folder to import; its format is recognised."""
    root: Path | None = None
    """Folder of the new LeRobotDataset; must not exist. BAM's logs become a recording set only."""
    repo_id: str = "local/imported"
    """LeRobot's name of the new dataset (npz only; a folder's dataset has no name of its own)."""
    fps: int = 10
    """Frames per second of the npz, which does not say; 10 follows from its fastest motion."""
    task: str = "insert the plug into the socket"
    """Natural-language task of every frame of the npz."""
    recording_dir: Path | None = None
    """New folder for a recording set for ``vtrefine-diagnose``: of BAM's logs, or of the npz as well."""
    pads: dict[str, str] = field(default_factory=dict)
    """New names of a folder's pads, e.g. '{primary: left_arm_left_finger}'; others keep theirs."""

    def __post_init__(self) -> None:
        if self.fps < 1:
            raise ValueError(f"--fps must be at least 1, got {self.fps}")
        if self.recording_dir is not None and self.recording_dir == self.root:
            raise ValueError("--recording_dir and --root must be two folders")


def import_dataset(config: ImportConfig) -> str:
    """Import and return one line about the result.

    Raises:
        ValueError: the source is of no known format, or not a valid one.
        FileExistsError: there is something where the result shall be.
    """
    if not config.source.exists():
        raise FileNotFoundError(f"--source={config.source} does not exist")
    if is_bam(config.source):
        return _import_bam(config)
    if config.source.suffix == ".npz" and config.source.is_file():
        return _import_npz(config, _root(config))
    if config.source.is_dir() and is_leflexitac(config.source):
        return _import_folder(config, _root(config))
    raise ValueError(f"--source={config.source} is of no format that can be imported: {FORMATS}")


def _root(config: ImportConfig) -> Path:
    if config.root is None:
        raise ValueError("give --root=DIR, the folder of the new dataset")
    return config.root


def _import_bam(config: ImportConfig) -> str:
    if config.root is not None or config.recording_dir is None:
        raise ValueError("BAM's logs become a recording set: give --recording_dir=DIR, and no --root")
    runs = read_bam(config.source)
    write_bam(runs, config.recording_dir)
    gains = plural(len({run.setting.kp for run in runs}), "gain")
    return f"{plural(len(runs), 'run')} of {runs[0].setting.motor} at {gains} -> {config.recording_dir}"


def _import_npz(config: ImportConfig, root: Path) -> str:
    if config.pads:
        raise ValueError("--pads has no meaning here: the npz holds no pads")
    episodes = read_aloha_npz(config.source)
    if config.recording_dir is not None and config.recording_dir.exists():
        raise FileExistsError(f"{config.recording_dir} exists; choose another --recording_dir or remove it")
    names = joint_keys(ALOHA)  # as robots record them: lerobot-replay reads these
    write_dataset(episodes, names, root, config.repo_id, config.fps, config.task)
    if config.recording_dir is not None:
        write_recording_set(episodes, ALOHA.joint_names, config.recording_dir, config.fps)
    frames = sum(len(episode.command) for episode in episodes)
    return f"{plural(len(episodes), 'episode')}, {plural(frames, 'frame')}, no touch -> {root}"


def _import_folder(config: ImportConfig, root: Path) -> str:
    if config.recording_dir is not None:
        raise ValueError(
            "--recording_dir is for the npz only; vtrefine-diagnose reads the new dataset itself"
        )
    summary = import_leflexitac(config.source, root, config.pads)
    lines = [f"{plural(summary.episodes, 'episode')}, {plural(summary.frames, 'frame')} -> {root}"]
    if summary.normalised:
        lines.append(f"raw counts recovered for {', '.join(summary.normalised)}")
        lines += [
            f"{pad}: exact but for {plural(len(frames), 'frame')}, which more than one scale fits: their"
            " contact may have been stronger (meta/import.json lists them)"
            for pad, frames in summary.ambiguous.items()
            if frames
        ]
    if summary.above_idle:
        lines.append(f"{', '.join(summary.above_idle)}: counts above an idle level that was not kept")
    return "; ".join(lines)


@parser.wrap()
def _main(config: ImportConfig) -> None:
    print(import_dataset(config))


@run_cli
def main() -> None:
    """Console entry point."""
    init_logging()
    logging.getLogger("PIL").setLevel(logging.INFO)
    _main()


if __name__ == "__main__":
    raise SystemExit(main())
