"""One world that can be watched and driven: it goes on after its episode has ended, until it is reset."""

from typing import Any

import numpy as np

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episode_log import episode_rows
from lerobot_vtrefine.envs.episodes import Array, Episodes, Raw
from lerobot_vtrefine.envs.factory import make_episodes
from lerobot_vtrefine.sim.task import FAILURES

IDS = np.array([0])
RUNNING = ""
SUCCESS, TIME_OUT, STOPPED = "success", "time_out", "stopped"


class LiveWorld:
    """The simulation that an environment's configuration describes, with one world.

    Shapes: J joints.
    """

    def __init__(self, config: VtRefineEnvConfig) -> None:
        self.config = config
        self._episodes: Episodes = make_episodes(config, 1)
        self.sim = self._episodes.sim
        self.seed = 0
        self.outcome = RUNNING
        """success, time_out or a failure; empty while the episode runs. The first outcome stays."""
        self.raw: Raw = {}
        """The raw frame last observed; looking at it draws no sensor noise."""
        self._moved = False
        self._row: dict[str, Any] = {}

    @property
    def steps(self) -> int:
        """Control steps of the episode; where it starts from a bank, those before that count."""
        return int(self.sim.steps[0])

    @property
    def time_s(self) -> float:
        """Simulated time of the episode."""
        return self.steps * self.sim.config.control_dt_s

    def reset(self, seed: int) -> None:
        """Start the episode of ``seed``."""
        self.seed, self.outcome = seed, RUNNING
        self._episodes.reset(IDS, np.array([seed]))
        self.raw = {key: value[0].copy() for key, value in self._episodes.raw.items()}
        self._moved = False

    def step(self, targets: Array) -> None:
        """One control step with absolute joint targets (J,) in rad and m."""
        self._moved = True
        self._episodes.steps += 1
        result = self.sim.step(np.asarray(targets, np.float64)[None], IDS, images=IDS)
        if self.outcome != RUNNING:
            return
        failure = FAILURES[int(self.sim.metrics(IDS)["failure"][0])]
        if failure != "none":
            self.outcome = failure
        elif result.success[0]:
            self.outcome = SUCCESS
        elif result.truncated[0]:
            self.outcome = TIME_OUT
        if self.outcome != RUNNING:
            self._row = self._measure(self.outcome)
            self._episodes.log([self._row])

    def observe(self) -> Raw:
        """The raw frame of this moment, as ``datasets.features`` describes it; no leading dimensions.

        Sensors are read once per step, however often they are asked: their noise is part of the episode.
        """
        if self._moved:
            self.raw = {key: value[0].copy() for key, value in self._episodes.read(IDS).items()}
            self._moved = False
        return self.raw

    def row(self) -> dict[str, Any]:
        """How the episode went: seed, steps, success, failure (none or a reason), metrics.

        An episode that still runs counts as stopped.
        """
        return dict(self._row) if self.outcome != RUNNING else self._measure(STOPPED)

    def _measure(self, outcome: str) -> dict[str, Any]:
        metrics = self.sim.metrics(IDS)
        failure = "none" if outcome == SUCCESS else outcome
        columns = {"seed": np.array([self.seed]), "steps": np.array([self.steps]), **metrics}
        return episode_rows(columns | {"failure": np.array([failure])})[0]
