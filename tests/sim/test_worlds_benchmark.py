"""The benchmark of worlds on mujoco_warp: what it says of memory. tests/cli has its run as a command."""

import pytest
import torch

from lerobot_vtrefine.sim import benchmark
from lerobot_vtrefine.sim.config import WarpConfig


class Driver:
    """A GPU's memory [bytes]: freed memory comes back when the host waits, torch's when told so."""

    def __init__(self):
        self.held, self.freed, self.cached, self.total = 1 << 30, 0, 0, 100 << 30

    def synchronize(self):
        self.held, self.freed = self.held - self.freed, 0

    def empty_cache(self):
        self.held, self.cached = self.held - self.cached, 0

    def mem_get_info(self):
        return self.total - self.held, self.total


class Simulation:
    """Takes some memory, and frees it when it is no longer needed."""

    def __init__(self, driver, size):
        self.driver, self.size = driver, size
        driver.held += size

    def __del__(self):
        self.driver.freed += self.size // 2
        self.driver.cached += self.size // 2


def test_memory_does_not_depend_on_what_was_measured_before(monkeypatch):
    driver, found = Driver(), []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for name in ("synchronize", "empty_cache", "mem_get_info"):
        monkeypatch.setattr(torch.cuda, name, getattr(driver, name))
    for gib in (4, 1, 2):
        benchmark._give_back()
        before = benchmark._memory_gib("cuda")
        simulation = Simulation(driver, gib << 30)
        driver.synchronize()  # as any step does
        found.append(benchmark._memory_gib("cuda") - before)
        simulation.itself = simulation  # as the parts of a simulation know each other
        del simulation
    assert found == pytest.approx([4, 1, 2])


@pytest.mark.gpu
@pytest.mark.timeout(900)
def test_memory_in_any_order_on_a_gpu():
    rows = list(benchmark.measure_worlds(WarpConfig(device="cuda"), (256, 1), steps=2))
    assert rows[0].memory_gib > 0.1
    assert 0 <= rows[1].memory_gib < rows[0].memory_gib
