import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import draccus
import numpy as np
import pytest
import yaml
from aloha_columns import TACTILE_KEYS
from draccus.utils import ParsingError
from fake_sim import FakeSim
from lerobot.configs import FeatureType
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features

from lerobot_vtrefine.datasets.features import DEPTH_KEY
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.envs import VtRefineEnvConfig, vector_env
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.envs.live_world import LiveWorld
from lerobot_vtrefine.sim.config import LimitsConfig, TaskConfig

ENV_FILES = sorted((Path(__file__).parents[2] / "configs" / "env").glob("*.yaml"))


def parse(*arguments: str) -> VtRefineEnvConfig:
    return draccus.parse(EvalPipelineConfig, args=["--env.type=vtrefine", *arguments]).env


@cache
def read(path: Path) -> EvalPipelineConfig:
    """What LeRobot's own parser makes of a file, which takes it most of a second; do not change it."""
    return draccus.parse(EvalPipelineConfig, config_path=path, args=[])


def test_type_is_registered():
    assert "vtrefine" in EnvConfig.get_known_choices()
    assert VtRefineEnvConfig().type == "vtrefine"


def test_flags_reach_every_level():
    config = parse(
        "--env.pair=square",
        "--env.clearance_m=0.001",
        "--env.start=grasped",
        "--env.fps=20",
        "--env.episode_steps=30",
        "--env.rules.limits.contact_force_n=25",
        "--env.scene.pad_friction=0.8",
        "--env.randomization.pad_friction=[0.5,1.0]",
        "--env.shear.on=true",
        "--env.shear.stiffness_n_per_m=250",
    )
    assert (config.scene_config.pair, config.scene_config.clearance_m) == ("square", 0.001)
    assert config.scene_config.pad_friction == 0.8
    assert config.task_config.control_hz == 20.0
    assert config.task_config.limits.contact_force_n == 25
    assert config.max_episode_steps == 30
    assert config.randomization.pad_friction == (0.5, 1.0)
    assert (config.shear.on, config.shear.stiffness_n_per_m) == (True, 250.0)
    assert not VtRefineEnvConfig().shear.on


def test_episode_length_follows_the_start():
    table, grasped = (VtRefineEnvConfig(start=start).max_episode_steps for start in ("table", "grasped"))
    assert table == 240
    assert grasped == TaskConfig().steps_of("grasped") < table
    assert VtRefineEnvConfig(start="table", episode_steps=7).max_episode_steps == 7
    assert VtRefineEnvConfig(start="table", fps=50).max_episode_steps == 5 * table  # as many seconds


def test_any_control_rate_runs_in_whole_physics_steps():
    for fps in (15, 100):
        config = VtRefineEnvConfig(start="grasped", fps=fps, num_threads=1)
        world = LiveWorld(config)
        world.reset(0)
        for _ in range(2):
            world.step(world.sim.command_targets()[0])
        assert world.sim.substeps * config.scene_config.timestep_s == pytest.approx(1 / fps)
        assert config.scene_config.timestep_s <= config.scene.timestep_s
        assert world.row()["failure"] == "stopped"


def test_policy_features_have_the_datasets_keys_and_shapes():
    config = VtRefineEnvConfig(start="grasped")
    features = env_to_policy_features(config)
    height, width = config.camera_size
    assert features[DEPTH_KEY].shape == (1, height, width)
    assert features[DEPTH_KEY].type is FeatureType.STATE  # no video can hold millimetres
    assert features[TACTILE_KEYS[0]].shape == (384,)
    assert features["action"].shape == (16,)


@pytest.mark.parametrize("path", ENV_FILES, ids=lambda path: path.stem)
def test_environment_files_parse_and_hold_only_env_and_eval(path: Path):
    assert set(yaml.safe_load(path.read_text())) <= {"env", "eval"}
    config = read(path)
    assert isinstance(config.env, VtRefineEnvConfig)
    assert config.env.scene_config.start == config.env.start


@pytest.mark.parametrize("path", ENV_FILES, ids=lambda path: path.stem)
def test_environment_files_suit_policies_of_every_chunk_length(path: Path, monkeypatch: pytest.MonkeyPatch):
    """A policy may decide at any step: each must hand out its own frame."""
    config = read(path).env
    monkeypatch.setattr(vector_env, "make_episodes", lambda config, n: Episodes(FakeSim(n)))
    env = vector_env.VtRefineVectorEnv(config, 1)
    env.reset(seed=[1])
    pad = f"tactile.{get_embodiment(config.scene_config.embodiment).pad_names[0]}"
    stamps = [int(env.step(np.zeros((1, 16)))[0][pad][0, 0]) for _ in range(9)]
    assert stamps == list(range(2, 11))


TWINS = [path for path in ENV_FILES if path.stem.endswith("_twin")]


@pytest.mark.parametrize("path", TWINS, ids=lambda path: path.stem)
def test_a_twin_differs_from_its_task_in_what_is_hidden_alone(path: Path):
    task, twin = (read(file).env for file in (path.with_stem(path.stem.removesuffix("_twin")), path))
    slip = twin.rules.grasped
    assert slip.slip_m == slip.slip_z_m == slip.slip_rad == 0.0
    assert min(task.rules.grasped.slip_m, task.rules.grasped.slip_rad) > 0.0
    known = replace(task.rules.grasped, slip_m=0.0, slip_z_m=0.0, slip_rad=0.0)
    assert twin.randomization.part_friction in (task.randomization.part_friction, None)
    same = replace(task.randomization, part_friction=twin.randomization.part_friction)
    assert twin == replace(task, rules=replace(task.rules, grasped=known), randomization=same)


def test_there_are_environment_files():
    assert len(TWINS) >= 3
    assert len(ENV_FILES) >= 3


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"start": "floor"}, "start"),
        ({"clearance_m": 0.0}, "clearance_m"),
        ({"episode_steps": 0}, "episode_steps"),
        ({"vectorization": "magic"}, "native, gym"),
        ({"backend": "gpu"}, "single, batch, warp"),
        ({"ablate": "smell"}, "none, touch, touch_shuffled, touch_other, vision"),
        ({"ablate": "touch"}, "--env.ablate_dataset"),
        ({"num_threads": -3}, "--env.num_threads must be at least 0, got -3"),
        ({"video_episodes": -1}, "--env.video_episodes must be at least 0, got -1"),
        ({"fps": 0}, "--env.fps must lie between 1 and 100 control steps a second, got 0"),
        ({"fps": 101}, "--env.fps must lie between 1 and 100 control steps a second, got 101"),
        ({"reality": Path("nowhere.json")}, r"--env\.reality=nowhere\.json: no such file; vtrefine-diagnose"),
    ],
)
def test_bad_settings_are_named_at_once(settings, message):
    with pytest.raises(ParsingError, match=message):
        VtRefineEnvConfig(**settings)
    # LeRobot's parser, and so the last line of its commands, says the same.
    with pytest.raises(ParsingError, match=message) as told:
        draccus.decode(EnvConfig, {"type": "vtrefine", **settings})
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scene": {"pad_friction": -1.0}}, "pad_friction must be above 0, got -1.0"),
        ({"scene": {"negative_control_m": math.nan}}, "negative_control_m must be a finite number, got nan"),
        ({"rules": {"finger_rate": 0.0}}, "finger_rate must be above 0"),
        ({"rules": {"table": {"square_m": math.nan}}}, "table.square_m must be a finite number, got nan"),
        ({"rules": {"grasped": {"slip_m": -0.01}}}, "grasped.slip_m must not be negative, got -0.01"),
        (
            {"rules": {"grasped": {"mouth_m": [0.0, 0.0, math.inf]}}},
            "grasped.mouth_m must be a finite number",
        ),
        ({"rules": {"success": {"hold_s": -1.0}}}, "success.hold_s must not be negative, got -1.0"),
        ({"rules": {"limits": {"contact_force_n": math.nan}}}, "limits.contact_force_n must be a finite"),
        (
            {"rules": {"limits": {"force_window_s": math.inf}}},
            "limits.force_window_s must be a finite number",
        ),
        (
            {"randomization": {"camera_position_m": math.nan}},
            "randomization.camera_position_m must be a finite",
        ),
        ({"warp": {"rows_per_world": 0}}, "warp.rows_per_world must be at least 1, got 0"),
    ],
)
def test_numbers_that_no_group_of_settings_takes_are_named_by_the_parser(settings, message):
    with pytest.raises(ParsingError, match=re.escape(message)):
        draccus.decode(EnvConfig, {"type": "vtrefine", **settings})


@pytest.mark.parametrize("steps", [0, 1.5, math.nan])
def test_an_episode_has_a_whole_number_of_steps(steps):
    with pytest.raises(ValueError, match="episode_steps must be a whole number from 1 on, got"):
        TaskConfig(episode_steps=steps)


def test_a_limit_may_be_infinite():
    assert LimitsConfig(in_hand_shift_m=math.inf, contact_force_n=math.inf).contact_force_n == math.inf


def test_control_rate_has_one_flag():
    with pytest.raises(ParsingError, match="fps"):
        VtRefineEnvConfig(rules=TaskConfig(control_hz=20.0))


def test_unknown_pair_and_missing_meshes_are_one_line(tmp_path):
    for settings, message in (
        ({"pair": "star"}, "round, square, hexagon"),
        ({"pair": "automate/00186"}, "mesh_dir"),
        ({"pair": "automate/00186", "mesh_dir": tmp_path / "none"}, "none"),
        ({"clearance_m": 0.2}, "clearance"),
        ({"sensor_model": str(tmp_path / "model.json")}, "model.json"),
    ):
        envs = make_env(VtRefineEnvConfig(start="grasped", **settings), n_envs=1)
        with pytest.raises((ValueError, OSError), match=message) as caught:
            envs["vtrefine"][0].reset(seed=[0])
        assert "\n" not in str(caught.value)


def test_zero_environments_are_refused():
    with pytest.raises(ValueError, match="at least 1"):
        make_env(VtRefineEnvConfig(), n_envs=0)
