"""The environments as Gymnasium and LeRobot's EnvHub make them."""

import shutil
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from lerobot.envs import factory
from lerobot.envs import utils as lerobot_envs

from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.gym_ids import environment_id
from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS, STARTS

ENV_FILE = Path(__file__).parents[2] / "hub" / "env.py"


def test_every_pair_and_start_has_an_id() -> None:
    assert environment_id("round", "grasped") == "lerobot_vtrefine/RoundGrasped-v0"
    assert environment_id("d_shape", "table") == "lerobot_vtrefine/DShapeTable-v0"
    for pair in PROCEDURAL_PAIRS:
        for start in STARTS:
            spec = gymnasium.spec(environment_id(pair, start))
            assert (spec.kwargs["pair"], spec.kwargs["start"]) == (pair, start)


@pytest.mark.parametrize("name", ["RoundGrasped", "SquareTable"])
def test_gymnasium_accepts_what_it_makes(name: str) -> None:
    env = gymnasium.make(f"lerobot_vtrefine.envs:lerobot_vtrefine/{name}-v0", num_threads=1, episode_steps=2)
    assert env.unwrapped.render_mode is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions are joint targets in rad and m, and positions have no bounds, as on hardware.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized|.*is (-)?infinity")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_it_draws_where_it_is_asked_to() -> None:
    settings = {"render_mode": "rgb_array", "num_threads": 1, "episode_steps": 2}
    env = gymnasium.make("lerobot_vtrefine/RoundGrasped-v0", **settings)
    env.reset(seed=0)
    frame = env.render()
    assert frame.dtype == np.uint8
    assert frame.shape[2] == 3
    env.close()


def test_many_worlds_in_one_simulation() -> None:
    env = gymnasium.make_vec(
        "lerobot_vtrefine/RoundGrasped-v0", 2, vectorization_mode="vector_entry_point", num_threads=1
    )
    observation, _ = env.reset(seed=[3, 4])
    assert observation["agent_pos"].shape[0] == env.num_envs == 2
    env.close()


def test_what_cannot_be_drawn_and_no_worlds_are_refused() -> None:
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(ValueError, match="render_mode=human is unknown; choose from rgb_array"):
            make("lerobot_vtrefine/RoundGrasped-v0", render_mode="human")
    for number in (0, -1):
        with pytest.raises(ValueError, match=f"need at least one environment, got {number}"):
            gymnasium.make_vec("lerobot_vtrefine/RoundGrasped-v0", number)


def test_lerobots_env_hub_makes_it_from_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(ENV_FILE, tmp_path / "env.py")
    monkeypatch.setattr(
        lerobot_envs, "hf_hub_download", lambda repo_id, filename, **_: str(tmp_path / filename)
    )
    envs = factory.make_env("somebody/vtrefine", n_envs=2, trust_remote_code=True)
    env = envs["vtrefine"][0]
    assert env.num_envs == 2
    observation, _ = env.reset(seed=[0, 1])
    assert observation["agent_pos"].shape[0] == 2
    env.close()

    module = lerobot_envs._load_module_from_path(str(ENV_FILE))
    config = VtRefineEnvConfig(pair="square", start="grasped", num_threads=1)
    chosen = lerobot_envs._call_make_env(module, n_envs=1, use_async_envs=False, cfg=config)
    assert chosen["vtrefine"][0].config.pair == "square"
