"""Asynchronous inference with vt_dp3: LeRobot's client and simulated robot against this package's server."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from ports import free_port

from lerobot_vtrefine.cli.policy_server import main
from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY
from lerobot_vtrefine.lerobot_compat import action_rates, arrays
from lerobot_vtrefine.observation import VisuoTactileConfig
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import make_vt_dp3_pre_post_processors
from lerobot_vtrefine.robots import VtRefineSimConfig

pytest.importorskip("grpc")
ENV = {"start": "grasped", "num_threads": 1}
CHUNK = 4


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A tiny policy, untrained: an episode ends after a few of its steps."""
    torch.manual_seed(0)
    config = VtDp3Config(
        preset="small",
        point_dims=(8, 8),
        point_features=8,
        down_dims=(32,),
        time_dim=8,
        horizon=8,
        n_action_steps=CHUNK,
        observation=VisuoTactileConfig(num_visual_points=8),
        device="cpu",
    )
    keys = (key for key in config.required_keys if key != STATE_KEY)
    config.input_features = {key: PolicyFeature(FeatureType.STATE, (384,)) for key in keys}
    config.input_features[STATE_KEY] = PolicyFeature(FeatureType.STATE, (16,))
    config.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (16,))}
    VtDp3Policy(config).save_pretrained(tmp_path / "policy")
    save_processors(tmp_path / "policy", config, around=torch.zeros(16), reach=1.0)
    return tmp_path / "policy"


def save_processors(folder: Path, config: VtDp3Config, around: torch.Tensor, reach: float) -> None:
    """Actions of this policy lie within ``reach`` of ``around`` (16 joint targets)."""
    bounds = {"min": around - reach, "max": around + reach}
    for part in make_vt_dp3_pre_post_processors(config, {STATE_KEY: bounds, ACTION_KEY: bounds}):
        part.save_pretrained(folder)


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[None]:
    """LeRobot's server and client make a folder logs/ where they are."""
    monkeypatch.chdir(tmp_path)
    yield
    arrays.uninstall()


def waited(until: object, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if until():
            return True
        time.sleep(0.05)
    return False


def test_a_simulated_robot_follows_a_policy_that_is_served(checkpoint: Path) -> None:
    from lerobot.async_inference.configs import RobotClientConfig
    from lerobot.async_inference.robot_client import RobotClient

    from lerobot_vtrefine.lerobot_compat.policy_server import start

    port = free_port()
    server = start("127.0.0.1", port, fps=10)
    client = RobotClient(
        RobotClientConfig(
            policy_type="vt_dp3",
            pretrained_name_or_path=str(checkpoint),
            robot=VtRefineSimConfig(env=ENV),
            actions_per_chunk=CHUNK,
            server_address=f"localhost:{port}",
            fps=10,
            aggregate_fn_name="latest_only",
        )
    )
    # The arms stay near where they start: else the parts slip, and the episode ends before a few chunks.
    start_targets = torch.tensor(list(client.robot.held_targets().values()))
    save_processors(checkpoint, VtDp3Config.from_pretrained(checkpoint), start_targets, reach=1e-3)
    try:
        assert client.start()
        world = client.robot.world
        threading.Thread(target=client.receive_actions, daemon=True).start()
        threading.Thread(target=client.control_loop, args=("insert",), daemon=True).start()
        assert waited(lambda: world.steps > 3 * CHUNK, 60)  # several chunks, each planned from pads and depth
    finally:
        client.stop()
        server.stop(grace=None)


@pytest.mark.parametrize(
    ("fps", "learned", "name", "told"),
    [
        (30, 30, None, "--robot.fps=10, but this command gives 30 actions a second"),
        (10, 20, None, "policy server: --fps=10, but the policy learned 20 actions a second: give --fps=20"),
        (10, 10, "no/such/policy", "policy server: .*no/such/policy"),
        (10, 10, None, None),
    ],
    ids=["another rate than the robot's", "another than the policy's", "no policy", "the same"],
)
def test_no_arm_moves_at_another_rate_than_learned(
    fps: int, learned: int, name: str | None, told: str | None, checkpoint: Path, monkeypatch
) -> None:
    from lerobot.async_inference.configs import RobotClientConfig
    from lerobot.async_inference.robot_client import RobotClient

    from lerobot_vtrefine.lerobot_compat.policy_server import start

    config = VtDp3Config.from_pretrained(checkpoint)
    config.fps = learned
    config.save_pretrained(checkpoint)
    monkeypatch.setattr(RobotClient, "start", RobotClient.start)  # put back at the end
    action_rates.install()
    action_rates.install()
    port = free_port()
    server = start("127.0.0.1", port, fps=10)
    client = RobotClient(
        RobotClientConfig(
            policy_type="vt_dp3",
            pretrained_name_or_path=name or str(checkpoint),
            robot=VtRefineSimConfig(env=ENV),
            actions_per_chunk=CHUNK,
            server_address=f"localhost:{port}",
            fps=fps,
        )
    )
    try:
        if told is None:
            assert client.start()
            return
        with pytest.raises(SystemExit, match=f"^error: {told}"):
            client.start()
        assert not client.robot.is_connected
    finally:
        if client.robot.is_connected:
            client.stop()
        server.stop(grace=None)


def test_a_policy_that_reads_two_frames_gets_the_step_before(checkpoint: Path) -> None:
    from lerobot.async_inference.helpers import TimedObservation, map_robot_keys_to_lerobot_features

    from lerobot_vtrefine.lerobot_compat import policy_server
    from lerobot_vtrefine.robots.vtrefine_sim import VtRefineSim

    robot = VtRefineSim(VtRefineSimConfig(env=ENV))
    robot.connect()
    observations = [robot.get_observation()]
    robot.send_action(robot.held_targets() | {"left_waist.pos": 0.2})
    observations.append(robot.get_observation())
    features = map_robot_keys_to_lerobot_features(robot)
    robot.disconnect()

    def served(seen: list[int]) -> list:
        server = policy_server.PadPolicyServer(policy_server.PolicyServerConfig())
        server._reset_server()
        server.policy_type, server.device, server.lerobot_features = "vt_dp3", "cpu", features
        server.actions_per_chunk, server.policy = 3, VtDp3Policy.from_pretrained(checkpoint)
        server.preprocessor, server.postprocessor = make_vt_dp3_pre_post_processors(
            server.policy.config, {key: {"min": -torch.ones(16), "max": torch.ones(16)} for key in KEYS}
        )
        for step in seen:
            timed = TimedObservation(float(step), step, observations[step])
            assert server._enqueue_observation(timed)  # however little the arms have moved
        torch.manual_seed(1)
        return server._predict_action_chunk(timed)

    plan = served([0, 1])
    assert [action.get_timestep() for action in plan] == [2, 3, 4]  # after the action that was executed
    assert not np.allclose(plan[0].get_action(), served([1])[0].get_action())
    np.testing.assert_array_equal(plan[0].get_action(), served([0, 1])[0].get_action())
    assert policy_server.window({3: "c", 5: "e", 6: "f"}, 6, 4) == ["c", "e", "e", "f"]


KEYS = (STATE_KEY, ACTION_KEY)


@pytest.mark.timeout(60)
def test_an_address_that_is_taken_is_one_line(capsys: pytest.CaptureFixture) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main([f"--port={taken.getsockname()[1]}"]) == 2
    assert "cannot listen at 127.0.0.1" in capsys.readouterr().err
    assert main(["--port=0"]) == 2
    assert "--port must lie between 1 and 65535" in capsys.readouterr().err


@pytest.mark.slow
def test_both_commands_over_localhost(checkpoint: Path, tmp_path: Path) -> None:
    port = free_port()
    quiet = os.environ | {"OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "env": quiet}
    command = [sys.executable, "-m", "lerobot_vtrefine.cli.policy_server", f"--port={port}"]
    server = subprocess.Popen(command, **pipes)
    try:
        assert server.stdout is not None
        assert any("listening at" in line for line in server.stdout)
        told = (tmp_path / "client.txt").open("w+")
        client = subprocess.Popen(
            [
                *(sys.executable, "-m", "lerobot.async_inference.robot_client"),
                *("--robot.type=vtrefine_sim", "--robot.env={start: grasped}", "--fps=10"),
                *(f"--server_address=localhost:{port}", "--policy_type=vt_dp3"),
                *(f"--pretrained_name_or_path={checkpoint}", f"--actions_per_chunk={CHUNK}"),
                "--aggregate_fn_name=latest_only",
            ],
            **pipes | {"stdout": told},
        )
        try:
            # The policy is no good: the first episode ends, and the robot goes on to the next.
            assert waited(lambda: "seed 0:" in (tmp_path / "client.txt").read_text(), 240), told.name
        finally:
            client.send_signal(signal.SIGINT)
            try:
                client.wait(30)
            except subprocess.TimeoutExpired:
                client.kill()  # LeRobot's own client may hang in closing its channel
    finally:
        server.send_signal(signal.SIGINT)
        assert server.wait(60) == 130
