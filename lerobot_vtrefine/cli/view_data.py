"""``vtrefine-view-data``: show a dataset's pads, point cloud, depth and motion on one timeline in rerun."""

import argparse
import errno
import os
import shlex
import shutil
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.cli.arguments import CommandParser, read_list
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_new_file
from lerobot_vtrefine.embodiments import pad_layout_of
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.view.rerun_viewer import import_rerun
from lerobot_vtrefine.whole_files import whole_file
from lerobot_vtrefine.wording import plural

DESCRIPTION = """\
Show a tactile dataset on one timeline in the rerun viewer: pads, the point cloud that the policy gets, depth,
joint positions and commands. lerobot-dataset-viz shows no touch. Needs rerun: pip install 'lerobot[viz]'."""
EPILOG = """\
examples:
  vtrefine-view-data --dataset.root=outputs/demos
  vtrefine-view-data --dataset.root=outputs/demos --episodes='[0, 2]' --save=demos.rrd"""
POINT_RADIUS_M = 0.001
LEAST_FREE_BYTES = 64 * 1024
"""With less than this left on the disk, the file is not whole."""
GREY = (138, 143, 152)


def make_parser() -> CommandParser:
    """Command line of ``vtrefine-view-data``."""
    parser = CommandParser("vtrefine-view-data", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add("--dataset.root", dest="root", type=Path, metavar="DIR", help="LeRobot dataset, by its folder")
    add("--dataset.repo_id", dest="repo_id", metavar="NAME", help="LeRobot dataset, by its name on the Hub")
    add("--episodes", type=episodes, metavar="LIST", help="episodes to show (default: '[0]')")
    add("--save", type=Path, metavar="FILE", help="write a rerun file (.rrd) instead of opening the viewer")
    add("--overwrite", action="store_true", help="replace a file of --save that is there already")
    return parser


def episodes(text: str) -> list[int]:
    """``[0, 2]`` or ``2``, as LeRobot's commands take them; ArgumentTypeError for anything else."""
    given = read_list(text)
    if any(type(index) is not int for index in given):
        raise argparse.ArgumentTypeError(f"give a list such as '[0, 2]', got {text!r}")
    return given


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Console entry point."""
    from lerobot_vtrefine.datasets.episodes import open_episodes

    options = make_parser().parse_args(arguments)
    if (options.root is None) == (options.repo_id is None):
        raise ValueError("give either --dataset.root=DIR or --dataset.repo_id=NAME")
    rr = import_rerun("vtrefine-view-data", options.save)
    if options.save is not None:
        check_new_file("--save", options.save, overwrite=options.overwrite, how="--overwrite")
    root = options.root or downloaded(options.repo_id)
    shown = options.episodes or [0]
    open_episodes(root).read(shown)  # before a viewer opens for nothing
    rr.init("vtrefine-view-data", spawn=options.save is None)
    with nullcontext() if options.save is None else saved(rr, options.save):
        frames = sum(log_episode(rr, root, index) for index in shown)
        rr.rerun_shutdown()
    where = f" -> {options.save}" if options.save is not None else ""
    print(f"{plural(len(shown), 'episode')}, {plural(frames, 'frame')}{where}")
    if options.save is not None:
        print(f"open it: rerun {shlex.quote(str(options.save))}")


@contextmanager
def saved(rr: Any, path: Path) -> Generator[None]:
    """What is logged within becomes a rerun file, whole or not at all.

    Raises:
        OSError: the disk is full, which rerun only logs.
    """
    with whole_file(path) as part:
        rr.save(part)
        yield
        if shutil.disk_usage(path.parent).free < LEAST_FREE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def downloaded(repo_id: str) -> Path:
    """The folder of a dataset in LeRobot's cache."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return Path(LeRobotDataset(repo_id, download_videos=False).root)


def log_episode(rr: Any, root: Path, index: int) -> int:
    """Send an episode to rerun; its number of frames.

    Raises:
        ValueError: the folder holds no such episode.
    """
    from lerobot_vtrefine.datasets.episodes import open_episodes

    folder = open_episodes(root)
    (episode,) = folder.read([index])
    clouds = clouds_of(root, index)
    joints = folder.joints or tuple(f"joint {k}" for k in range(folder.num_joints))
    prefix = f"episode_{index}"
    for k, time_s in enumerate(episode.time_s):
        rr.set_time("time", duration=float(time_s))
        for pad, counts in episode.counts.items():
            picture = pad_picture(counts[k], episode.baselines[pad], pad_layout_of(pad))
            rr.log(f"{prefix}/pads/{pad}", rr.Image(picture))
            rr.log(f"{prefix}/pad_sums/{pad}", rr.Scalars(above(counts[k], episode.baselines[pad]).sum()))
        for name, position, command in zip(joints, episode.state[k], episode.action[k], strict=True):
            rr.log(f"{prefix}/joints/{name}/position", rr.Scalars(position))
            rr.log(f"{prefix}/joints/{name}/command", rr.Scalars(command))
        seen = next(clouds, None)
        if seen is not None:
            points, depth = seen
            rr.log(
                f"{prefix}/cloud",
                rr.Points3D(points[:, :3], colors=cloud_colours(points), radii=POINT_RADIUS_M),
            )
            rr.log(f"{prefix}/depth", rr.DepthImage(depth, meter=1000.0))
    return len(episode.time_s)


def clouds_of(root: Path, index: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Point cloud (N, 5) and depth image (H, W) [mm] of every frame; nothing for a dataset without depth."""
    import pyarrow.parquet as pq

    from lerobot_vtrefine.cli.report.cloud import body_of, build_cloud, depth_mm, needed
    from lerobot_vtrefine.files.tables import read_table

    for path in sorted((root / "data").rglob("*.parquet")):
        body = body_of(pq.read_schema(path).names)
        if body is None:
            return
        table = read_table(path, ["episode_index", "frame_index", *needed(body)])
        mine = np.flatnonzero(table["episode_index"].to_numpy() == index)
        for place in mine:
            row = table.slice(int(place), 1).to_pylist()[0]
            yield build_cloud(row, body), depth_mm(row)


def above(counts: np.ndarray, idle: np.ndarray) -> np.ndarray:
    """Counts above the idle level."""
    return np.clip(counts.astype(float) - idle, 0.0, None)


def pad_picture(counts: np.ndarray, idle: np.ndarray, layout: PadLayout) -> np.ndarray:
    """A pad as it is drawn live, RGB (R, C, 3); one that has not the layout's taxels as a single row."""
    from lerobot_vtrefine.tactile.picture import colours

    shape = (layout.rows, layout.cols) if counts.size == layout.num_taxels else (1, counts.size)
    return colours(counts.reshape(shape), idle.reshape(shape))


def cloud_colours(points: np.ndarray) -> np.ndarray:
    """Seen points grey, taxels by their reading: RGB (N, 3)."""
    from matplotlib import colormaps

    felt = colormaps["viridis"](np.clip(points[:, 3], 0, 1), bytes=True)[:, :3]
    return np.where(points[:, 4:] > 0, felt, np.array(GREY, np.uint8))


if __name__ == "__main__":
    raise SystemExit(main())
