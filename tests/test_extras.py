"""Without an extra: the core works, and whatever needs the extra says so in one line, and how to install it.

Modules are hidden from whole processes, as on a machine where they are not installed.
"""

import json
import os
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
from loaded_process import LoadedProcess

from lerobot_vtrefine.extras import EXTRA_OF

ROOT = Path(__file__).parents[1]
BLOCKED = ROOT / "tests" / "blocked" / "sitecustomize.py"
SIMULATORS = ("mujoco", "warp", "mujoco_warp", "trimesh", "manifold3d")
DEVICES = ("serial", "dynamixel_sdk", "deepdiff", "evdev", "pynput", "rerun", "foxglove")
INSTALL = "pip install 'lerobot_policy_vtrefine[{}]'"

# What every Python does at its start that this one starts.
HIDE = f"""
import runpy, sys
blocked = runpy.run_path({str(BLOCKED)!r})["BLOCKED"]
assert not set(blocked) & set(sys.modules)
"""

# Many commands in one process: importing LeRobot takes most of the time.
RUN_COMMANDS = """
import contextlib, importlib, io, json, signal, sys
results = []
for name, *arguments in json.loads(sys.argv[1]):
    package = "lerobot_vtrefine.cli." if not name.startswith("lerobot") else "lerobot.scripts."
    sys.argv = [name, *arguments]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = importlib.import_module(package + name).main()
        except SystemExit as stop:
            status = stop.code
        except Exception as error:  # as Python prints it last when a stock command ends with a traceback
            status, _ = 1, err.write(f"{type(error).__name__}: {error}")
    results.append([status or 0, out.getvalue(), err.getvalue().strip().splitlines()])
print(json.dumps(results))
"""


def run_without(
    loaded: LoadedProcess, modules: tuple[str, ...], code: str, *arguments: str
) -> subprocess.CompletedProcess[str]:
    """Run code where these modules cannot be found."""
    paths = [str(BLOCKED.parent), os.environ.get("PYTHONPATH", "")]
    hidden = {"BLOCKED_MODULES": ",".join(modules), "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    return loaded.run(HIDE + code, *arguments, cwd=ROOT, **hidden)


def run_commands(loaded: LoadedProcess, modules: tuple[str, ...], commands: list[list[str]]) -> list[Any]:
    """(status, text, lines on standard error) of each command, without these modules."""
    done = run_without(loaded, modules, RUN_COMMANDS, json.dumps(commands))
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.strip().splitlines()[-1])


def test_the_core_leaves_the_simulator_to_an_extra() -> None:
    """LeRobot's own aloha, libero and hilserl environments cap MuJoCo below 3.9."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    names = {re.split(r"[\[<>=~! ;]", line)[0] for line in project["dependencies"]}
    assert "lerobot" in names
    assert not {"mujoco", "warp-lang", "mujoco-warp", "trimesh", "pyserial"} & names
    assert {re.split("[<>]", line)[0] for line in extras["sim"]} == {"mujoco", "warp-lang"}
    for built_on_it in ("gpu", "assets", "dev"):
        assert any(re.match(r"lerobot_policy_vtrefine\[.*\bsim\b", line) for line in extras[built_on_it])


def test_every_package_of_an_extra_is_known_by_what_is_imported() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    imported_as = {"warp-lang": "warp", "mujoco-warp": "mujoco_warp", "pyserial": "serial"}
    brought = {
        imported_as.get(name, name): extra
        for extra, lines in project["optional-dependencies"].items()
        for name in (re.split(r"[\[<>=~! ;]", line)[0] for line in lines)
        if extra not in ("docs", "dev") and not name.startswith("lerobot")
    }
    assert {module: EXTRA_OF.get(module) for module in brought} == brought


@pytest.mark.timeout(900)
def test_recording_training_and_rollout_need_no_simulator(loaded: LoadedProcess) -> None:
    test = "tests/robots/test_rollout.py::test_record_train_and_roll_out_on_the_same_robot"
    arguments = ("-q", "-m", "slow", "-p", "no:cacheprovider", "-p", "no:xdist", test)
    code = "import pytest; raise SystemExit(pytest.main())"
    done = run_without(loaded, SIMULATORS, code, *arguments)
    assert done.returncode == 0, done.stdout[-3000:]
    assert "1 passed" in done.stdout


@pytest.mark.timeout(900)
def test_what_simulates_names_the_extra(loaded: LoadedProcess, tiny_dataset: Path, tmp_path: Path) -> None:
    checkpoint = str(tmp_path / "checkpoint")
    env, dataset = "--env.type=vtrefine", f"--dataset.root={tiny_dataset}"
    out = f"--output_dir={tmp_path / 'out'}"
    commands = [
        ["lerobot_eval", env, f"--policy.path={checkpoint}"],
        ["lerobot_train", env, "--policy.type=vt_dp3", "--dataset.repo_id=local/tiny", dataset],
        ["record_demos", env, f"--root={tmp_path / 'demos'}", "--num_episodes=1"],
        ["finetune", env, f"--policy.path={checkpoint}", out],
        ["demo", out],
        ["replay", dataset, out],
        ["bench", "--plot"],
        ["press", out],
        ["bench", "--parts=[tactile, envs]"],
    ]
    for command, (status, _, lines) in zip(commands, run_commands(loaded, SIMULATORS, commands), strict=True):
        assert status in (1, 2), command
        assert "extra [sim]" in lines[-1], (command, lines[-3:])
        assert INSTALL.format("sim") in lines[-1], command
        if not command[0].startswith("lerobot"):
            told = [line for line in lines if line.startswith("error:")]
            assert len(told) == (0 if "--parts" in command[1] else 1), (command, lines)
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "demos").exists()


@pytest.mark.timeout(900)
def test_what_reads_ports_names_the_extra(loaded: LoadedProcess, tmp_path: Path) -> None:
    data = [
        "--dataset.repo_id=local/x",
        f"--dataset.root={tmp_path / 'x'}",
        "--dataset.single_task=wait",
        "--dataset.push_to_hub=false",
    ]
    arms = ["left_port=a", "right_port=b"]
    follower = ["--robot.type=aloha_tactile_follower", *(f"--robot.{port}" for port in arms)]
    leader = ["--teleop.type=aloha_leader", *(f"--teleop.{port}" for port in arms)]
    helps = [["find_pads", "--help"], ["view_pads", "--help"], ["pad_emulator", "--help"]]
    commands = [
        ["find_pads"],
        ["find_pads", "--ports", "nowhere"],
        ["view_pads", "--ports", "nowhere"],
        ["lerobot_record", *follower, *leader, *data],
        [
            "lerobot_record",
            "--robot.type=tactile",
            "--robot.base={type: so101_follower, port: c}",
            *leader,
            *data,
        ],
        ["lerobot_teleoperate", *follower, *leader],
    ]
    results = run_commands(loaded, DEVICES, [*helps, *commands])
    for command, (status, text, _) in zip(helps, results, strict=False):
        assert (status, "usage:" in text) == (0, True), command
    for command, (status, _, lines) in zip(commands, results[len(helps) :], strict=True):
        assert status in (1, 2), command
        assert "extra [hardware]" in lines[-1], (command, lines[-3:])
        assert INSTALL.format("hardware") in lines[-1], command
        if not command[0].startswith("lerobot"):
            assert len(lines) == 1, (command, lines)
    assert not (tmp_path / "x").exists()


def test_the_camera_of_a_pad_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its robot's own devices are looked for first, so in this process."""
    from lerobot.cameras.utils import make_cameras_from_configs

    from lerobot_vtrefine.cameras import FlexitacCameraConfig

    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        ValueError, match=r"camera type flexitac needs the extra \[hardware\] \(serial not found"
    ):
        make_cameras_from_configs({"pad": FlexitacCameraConfig(port="nowhere")})
