"""A simulation in step with the clock on the wall: never ahead of it, and how far behind."""

import time

import numpy as np


class Pace:
    """Counts control steps of `dt_s` against the clock."""

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self.restart()

    def restart(self) -> None:
        """Count from now."""
        self._began: float | None = None
        self._steps = 0
        self._busy_s: list[float] = []

    def step_done(self, busy_s: float) -> None:
        """Note a control step that took `busy_s` to compute, and wait while the simulation is ahead.

        The first step never waits, and step n until n - 1 `dt_s` after the first one began: a loop that keeps
        the same rate never waits here.
        """
        now = time.perf_counter()
        if self._began is None:
            self._began = now - busy_s
        self._steps += 1
        self._busy_s.append(busy_s)
        ahead_s = self._began + (self._steps - 1) * self._dt_s - now
        if ahead_s > 0:
            time.sleep(ahead_s)

    def describe(self) -> str:
        """Simulated and real time since the start, and what a step costs; empty before the first step."""
        if self._began is None:
            return ""
        simulated_s = self._steps * self._dt_s
        lag_s = max(0.0, time.perf_counter() - self._began - simulated_s)
        busy_ms = 1e3 * np.array(self._busy_s)
        return (
            f"{simulated_s:.1f} s simulated, {lag_s:.2f} s behind real time; a step takes "
            f"{np.median(busy_ms):.1f} ms (99 % within {np.percentile(busy_ms, 99):.1f} ms) "
            f"of {1e3 * self._dt_s:.0f} ms"
        )
