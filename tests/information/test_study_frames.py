"""The frames of a study: whose episodes they are, and that there are enough."""

from types import SimpleNamespace

import pytest
from test_information import synthetic

from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.information import closed_loop
from lerobot_vtrefine.information.frames import FIRST_SEED
from lerobot_vtrefine.information.study import Effort, study


def test_another_seed_studies_other_episodes_and_never_those_of_the_expert(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They had been the same whatever the seed, as if several studies were independent."""
    begun: list[int] = []
    nothing = SimpleNamespace(sim=None, part_poses=None)
    for name in ("make_episodes", "MisjudgedHolds", "ScriptedExpert"):
        monkeypatch.setattr(f"lerobot_vtrefine.information.frames.{name}", lambda *_: nothing)
    monkeypatch.setattr(
        "lerobot_vtrefine.information.frames._one_batch", lambda *given: begun.append(given[3]) or nothing
    )
    for seed in (0, 5000):
        with pytest.raises(AttributeError):  # of a batch that holds nothing
            study(VtRefineEnvConfig(), ["joints"], Effort(episodes=8, num_envs=4, seed=seed))
    assert begun == [FIRST_SEED + seed for seed in (0, 4, 5000, 5004)]
    most = closed_loop.FIRST_SEED - FIRST_SEED - 1024
    Effort(seed=most)
    for seed in (-1, most + 1):
        with pytest.raises(ValueError, match=f"--effort.seed must be within 0..{most}, got {seed}"):
            Effort(seed=seed)


@pytest.mark.parametrize("part", [slice(51), slice(51, None)])
def test_parts_never_held_in_training_or_in_what_is_held_out_are_one_line(part, monkeypatch) -> None:
    """They had ended in tracebacks."""
    frames = synthetic(0)
    frames.held[part] = False
    monkeypatch.setattr("lerobot_vtrefine.information.study.collect_frames", lambda *_: frames)
    few = Effort(episodes=60, num_envs=4, steps=1, closed_loop_episodes=0, tolerance_episodes=0)
    with pytest.raises(ValueError, match=r"got into the hands too seldom: raise --effort\.episodes"):
        study(VtRefineEnvConfig(), ["tactile"], few)
