"""``vtrefine-replay``: run a dataset's commands in the simulated twin and compare what both measured.

example:
  vtrefine-replay --dataset.root=outputs/demos --episodes='[0, 1]' --output_dir=outputs/replay
"""

import logging
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs import parser
from lerobot.configs.default import EvalConfig
from lerobot.envs.configs import EnvConfig
from lerobot.utils.utils import init_logging

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import OVERWRITE, staged
from lerobot_vtrefine.datasets.episodes import EpisodeFolder, open_episodes
from lerobot_vtrefine.diagnose.episode_replay.compare import (
    HOLDS,
    PARTS,
    Comparison,
    compare_episodes,
    write_summary,
)
from lerobot_vtrefine.envs.config import checked_env

FILES = ("replay.json", "report.html")


@dataclass
class SourceConfig:
    """The dataset to replay."""

    root: Path | None = None
    """Its folder."""
    repo_id: str | None = None
    """Its name on the Hub, or in LeRobot's cache; needed only without a folder."""


@dataclass
class ReplayConfig:
    """Flags of ``vtrefine-replay``."""

    output_dir: Path
    """Folder for replay.json and report.html."""
    dataset: SourceConfig = field(default_factory=SourceConfig)
    """What to replay."""
    episodes: list[int] | None = None
    """Episodes to replay, e.g. '[0, 3]'; all by default."""
    parts: str = "auto"
    """none: arms alone, tracking only. recorded: the starts of a simulated dataset. grasp: parts stand where
    the recorded grippers closed. auto: what the dataset allows."""
    hold: str = "zero_order"
    """How arms alone approach a command: zero_order or linear."""
    env: EnvConfig | None = None
    """The twin (--env.sensor_model=FILE ...); by default what a simulated dataset was recorded in."""
    video: bool = True
    """Draw the twin in the first episode, where there are parts."""
    overwrite: bool = False
    """Replace results that are there already."""
    eval: EvalConfig = field(default_factory=EvalConfig)
    """Unused; lets files of configs/env serve this command too."""

    def __post_init__(self) -> None:
        if self.dataset.root is None and self.dataset.repo_id is None:
            raise ValueError("say what to replay: --dataset.root=FOLDER, or --dataset.repo_id=NAME")
        check_choice("--hold", self.hold, HOLDS)
        check_choice("--parts", self.parts, PARTS)
        if self.episodes is not None and not self.episodes:
            raise ValueError("--episodes is empty; leave it out to replay all of them")
        if self.env is not None:
            checked_env(self.env)


def replay(config: ReplayConfig) -> Comparison:
    """Replay, compare, and write ``report.html`` and ``replay.json``.

    Raises:
        FileExistsError: the output folder holds a report already.
        ValueError: a dataset that cannot be replayed in the twin.
    """
    from lerobot_vtrefine.diagnose.episode_replay.page import render_page

    env = None if config.env is None else checked_env(config.env)
    with staged(config.output_dir, FILES, overwrite=config.overwrite, flag=OVERWRITE) as folder:
        comparison = compare_episodes(
            _folder(config.dataset),
            config.episodes,
            parts=config.parts,
            hold=config.hold,
            env=env,
            film=config.video,
        )
        write_summary(comparison, folder / FILES[0])
        (folder / FILES[1]).write_text(render_page(comparison), encoding="utf-8")
    return comparison


def _folder(source: SourceConfig) -> EpisodeFolder:
    if source.root is not None:
        return open_episodes(source.root)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    assert source.repo_id is not None
    return open_episodes(Path(LeRobotDataset(source.repo_id, download_videos=False).root))


def describe(comparison: Comparison) -> list[str]:
    """The result in a few lines of text."""
    from lerobot_vtrefine.diagnose.episode_replay.figures import unit_of
    from lerobot_vtrefine.diagnose.episode_replay.page import verdict

    count = len(comparison.pairs)
    lines = [verdict(comparison), f"{count} episode{'s' * (count != 1)}; {comparison.twin}"]
    for row in comparison.tracking:
        unit, explained = unit_of(row.joint), ""
        if row.explained is not None:
            explained = f", explains {100 * row.explained:.0f} %"
        lines.append(
            f"  {row.joint:<20} RMSE {1e3 * row.rmse:6.1f} {unit:<4} bias {1e3 * row.bias:+6.1f}{explained}"
        )
    for pad in comparison.touch:
        overlap = "feels nothing" if pad.overlap is None else f"overlap {pad.overlap:.3f}"
        lines.append(f"  {pad.pad:<24} {overlap}, {pad.identical_frames} of {pad.frames} frames identical")
    lines += [f"note: {remark}" for remark in comparison.remarks]
    return lines


@parser.wrap()
def _main(config: ReplayConfig) -> None:
    print("\n".join(describe(replay(config))))
    print(f"-> {config.output_dir / FILES[1]}")


@run_cli
def main() -> None:
    """Console entry point."""
    init_logging()
    logging.getLogger("PIL").setLevel(logging.INFO)
    logging.getLogger("matplotlib").setLevel(logging.WARNING)
    _main()


if __name__ == "__main__":
    raise SystemExit(main())
