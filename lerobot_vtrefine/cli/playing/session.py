"""Episode after episode in one world, watched or not."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from lerobot_vtrefine.cli.playing.agents import Agent
from lerobot_vtrefine.envs.live_world import LiveWorld
from lerobot_vtrefine.wording import plural

if TYPE_CHECKING:
    from lerobot_vtrefine.view.browser import Wishes

IDLE_S = 0.02
"""How often a paused simulation looks whether somebody wants something."""
LAST_LOOK_S = 1.5
"""An episode's end stays in view this long."""


class View(Protocol):
    """Who looks on."""

    wishes: "Wishes"

    def update(self, now: bool = False) -> None:
        """Draw the world."""
        ...


class Session:
    """Plays episodes of consecutive seeds.

    Args:
        world: where.
        agent: who moves the arms.
        view: who looks on; None plays as fast as the machine can.
        video_dir: where videos go, one per recorded episode.
        tell: gets one line of text per finished episode.
    """

    def __init__(
        self, world: LiveWorld, agent: Agent, view: View | None, video_dir: Path, tell: Callable[[str], None]
    ) -> None:
        self._world, self._agent, self._view = world, agent, view
        self._video_dir, self._tell = video_dir, tell
        self._renderer: Any = None
        self._frames: list[np.ndarray] = []
        self.rows: list[dict[str, Any]] = []
        """How the finished episodes went."""

    def play(self, first_seed: int, episodes: int | None, record: bool) -> None:
        """Play episodes of seeds from `first_seed` on; None plays without end."""
        seed, self._record = first_seed, record
        while episodes is None or len(self.rows) < episodes:
            if self._episode(seed):
                self.rows.append(self._world.row())
                self._tell(f"{_describe(self.rows[-1])} ({self._tally()})")
                self._save_video()
                seed += 1
                if self._view is not None:
                    self._view.update(now=True)
                    time.sleep(LAST_LOOK_S)
            else:
                assert self._view is not None
                seed = self._view.wishes.seed
                self._frames.clear()

    def close(self) -> None:
        """Free what draws the videos."""
        if self._renderer is not None:
            self._renderer.close()

    def _tally(self) -> str:
        return f"{sum(bool(row['success']) for row in self.rows)} of {len(self.rows)} succeeded"

    def _episode(self, seed: int) -> bool:
        """Whether the episode of `seed` ended; it does not where somebody resets it."""
        world = self._world
        world.reset(seed)
        self._agent.reset(world)
        began = time.perf_counter() - world.time_s
        while not world.outcome:
            if self._view is not None:
                if self._view.wishes.reset:
                    self._view.wishes.reset = False
                    return False
                began += self._wait(self._view)
                if self._view.wishes.reset:
                    continue
            targets = self._agent.act(world)
            if targets is None:
                return True
            world.step(targets)
            world.observe()
            self._film()
            if self._view is not None:
                self._view.update()
                time.sleep(max(0.0, began + world.time_s - time.perf_counter()))
        return True

    def _wait(self, view: View) -> float:
        """Wait while the page says so; returns for how long [s]."""
        began, wishes = time.perf_counter(), view.wishes
        view.update()
        while wishes.paused and not (wishes.step or wishes.reset):
            time.sleep(IDLE_S)
            view.update()
        wishes.step = False
        return time.perf_counter() - began

    def _film(self) -> None:
        if not (self._record or (self._view is not None and self._view.wishes.record)):
            return
        if self._renderer is None:
            from lerobot_vtrefine.sim.render import VideoRenderer

            world = self._world
            self._renderer = VideoRenderer(world.sim, menagerie_dir=world.config.menagerie_dir)
        self._frames.append(self._renderer.frame())

    def _save_video(self) -> None:
        if not self._frames:
            return
        from lerobot.utils.io_utils import write_video

        self._video_dir.mkdir(parents=True, exist_ok=True)
        path = self._video_dir / f"seed_{self._world.seed}.mp4"
        write_video(path, self._frames, round(self._world.sim.config.control_hz))
        self._frames.clear()
        self._tell(f"-> {path}")


def _describe(row: dict[str, Any]) -> str:
    if row["success"] and row["failure"] == "none":
        return f"seed {row['seed']}: success after {row['time_to_success_s']:.1f} s"
    return f"seed {row['seed']}: {row['failure'].replace('_', ' ')} after {plural(row['steps'], 'step')}"
