"""Kernels on streams of their own: in whatever order that these allow, the step is the same."""

import numpy as np
import pytest

from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig, WarpConfig
from lerobot_vtrefine.sim.simulation import InsertionSim

pytest.importorskip("mujoco_warp")
wp = pytest.importorskip("warp")
pytestmark = pytest.mark.timeout(900)

WORLDS = np.arange(2)
MAIN = "main"
WORK = {"launch": wp, "launch_tiled": wp, "copy": wp, "zero_": wp.array, "fill_": wp.array}


class Streams:
    """Notes what a step asks for, on which stream and after what, in place of doing it."""

    def __init__(self, step, monkeypatch):
        self.now, self.last, self.jobs = MAIN, {}, []
        for name, owner in WORK.items():
            monkeypatch.setattr(owner, name, self.noted(getattr(owner, name)))
        monkeypatch.setattr(step, "_beside", self.beside)
        monkeypatch.setattr(step, "_join", lambda name: self.wait_for(name))

    def noted(self, work):
        def note(*args, **options):
            after = self.last.get(self.now, frozenset())
            self.last[self.now] = frozenset([len(self.jobs)])
            self.jobs.append((after, lambda: work(*args, **options)))

        return note

    def wait_for(self, name):
        self.last[self.now] = self.last.get(self.now, frozenset()) | self.last.get(name, frozenset())

    def beside(self, name):
        outer = self

        class Beside:
            def __enter__(self):
                self.before, outer.now = outer.now, name
                outer.wait_for(self.before)

            def __exit__(self, *_):
                outer.now = self.before

        return Beside()


def in_order(jobs, rank):
    """Do all jobs, of those that may begin always the one of least rank."""
    left = dict(enumerate(jobs))
    while left:
        ready = [number for number, (after, _) in left.items() if not after & left.keys()]
        left.pop(min(ready, key=lambda number: rank[number]))[1]()


@pytest.fixture(scope="module")
def sim():
    scene = SceneConfig(start="grasped", timestep_s=0.004)
    sim = InsertionSim(scene, TaskConfig(), num_envs=2, backend="warp", warp=WarpConfig(device="cpu"))
    sim.reset(WORLDS, WORLDS)
    return sim


def test_the_order_among_streams_does_not_matter(sim, monkeypatch):
    backend, rng = sim._backend, np.random.default_rng(0)
    worlds, start = backend.worlds, backend.get_rows(WORLDS)
    found = []
    for trial in range(6):
        backend.set_rows(WORLDS, start)
        worlds.data.ctrl.assign(sim._episode.command + 0.02)
        with wp.ScopedDevice("cpu"):
            qpos, qvel = backend.read(WORLDS)
            backend.write(WORLDS, qpos, qvel + rng.normal(0, 0.3, qvel.shape))
            worlds.step()  # leaves in all memory something else than what is to come
            backend.set_rows(WORLDS, start)
            with monkeypatch.context() as patched:
                streams = Streams(worlds.step, patched)
                worlds.step()
            number = len(streams.jobs)
            assert number > 50
            orders = (np.arange(number), -np.arange(number))
            in_order(streams.jobs, orders[trial] if trial < 2 else rng.permutation(number))
        found.append(backend.get_rows(WORLDS))
    assert np.abs(found[0] - start).max() > 1e-4
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])
