"""Expected failures of a command become one line and an exit status."""

import errno
import subprocess
import sys
from dataclasses import dataclass, field

import draccus
import httpx
import pytest
import safetensors
import torch

from lerobot_vtrefine.cli import diagnose
from lerobot_vtrefine.cli.errors import after_interrupt, run_cli
from lerobot_vtrefine.cli.pipeline.demo_config import DemoConfig
from lerobot_vtrefine.cli.play import PlayConfig
from lerobot_vtrefine.cli.record_demos import RecordDemosConfig
from lerobot_vtrefine.cli.replay import ReplayConfig
from lerobot_vtrefine.finetune.pipeline import FinetunePipelineConfig
from lerobot_vtrefine.interrupts import HungUp, Terminated


def failing(error: BaseException):
    @run_cli
    def main() -> None:
        raise error

    return main


def test_success_is_zero() -> None:
    assert run_cli(lambda: None)() == 0
    assert run_cli(lambda: 3)() == 3


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("clearance_m must be\npositive"), "error: clearance_m must be positive"),
        (FileNotFoundError(errno.ENOENT, "No such file", "x.json"), "error: No such file: x.json"),
        (FileNotFoundError("no folder meshes"), "error: no folder meshes"),
        (
            OSError(errno.ENOSPC, "No space left on device", "data.parquet"),
            "error: the disk is full while writing data.parquet; free some space and run the command again",
        ),
        (ImportError("pip install trimesh"), "error: pip install trimesh"),
        (ValueError(), "error: ValueError"),
    ],
)
def test_expected_error_is_one_line(error: Exception, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert failing(error)() == 2
    assert capsys.readouterr().err == line + "\n"


@pytest.mark.parametrize(
    ("error", "status"), [(KeyboardInterrupt(), 130), (Terminated(), 143), (HungUp(), 129)]
)
def test_interrupt(error: KeyboardInterrupt, status: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert failing(error)() == status
    assert capsys.readouterr().err == "interrupted\n"


def test_the_status_of_a_failed_command_is_that_of_the_one_that_ran_it() -> None:
    assert failing(subprocess.CalledProcessError(3, ["vtrefine-demo"]))() == 3


def test_defects_and_debug_keep_the_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RuntimeError):
        failing(RuntimeError("a defect"))()
    monkeypatch.setenv("VTREFINE_DEBUG", "1")
    with pytest.raises(ValueError, match="bad value"):
        failing(ValueError("bad value"))()


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--num_demos=0", "--num_demos must be at least 1, got 0"),
        ("--modalities=smell", "choose from visuo_tactile, visual"),
        ("--num_demos=many", "Couldn't parse 'many' into an int"),
    ],
)
def test_wrong_flag_names_itself(flag: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    @run_cli
    def main() -> None:
        draccus.parse(DemoConfig, args=[flag])

    assert main() == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@dataclass
class Flags:
    num_episodes: int = 1
    env: dict = field(default_factory=dict)


@pytest.mark.parametrize(
    ("config", "typed", "line"),
    [
        (
            Flags,
            ["--num_epsodes=3"],
            "unrecognized arguments: --num_epsodes=3; did you mean --num_episodes?",
        ),
        (Flags, ["--zzz=3"], "unrecognized arguments: --zzz=3; --help lists the flags"),
        (
            RecordDemosConfig,
            ["--root=x", "--env.pair=round"],
            "say which environment: --env.type=vtrefine or --config_path=vtrefine:NAME",
        ),
        (
            FinetunePipelineConfig,
            ["--env.type=vtrefine", "--policy.device=cpu"],
            "say which policy: --policy.path=FOLDER, a checkpoint's pretrained_model",
        ),
        (PlayConfig, ["--seed=many"], "`seed`: Couldn't parse 'many' into an int"),
        (PlayConfig, ["--env.type=vtrefine", "--env.fps=x"], "`env.fps`: Couldn't parse 'x' into an int"),
        (
            RecordDemosConfig,
            ["--root=x", "--env.type=vtrefine", "--env.scene.camera=5"],
            "`env.scene.camera`: is a group of settings, not one value; --help lists",
        ),
        (
            RecordDemosConfig,
            ["--root=x", "--env.type=vtrefine", "--env.scene=5"],
            "`env.scene`: is a group of settings, not one value; --help lists",
        ),
        (
            PlayConfig,  # whose environment may be left out
            ["--env.type=vtrefine", "--env.rules.limits.contact_force_n=-1"],
            "`env`: limits.contact_force_n must be above 0, got -1.0",
        ),
        (ReplayConfig, ["--episodes=[one]"], "`episodes.0`: Couldn't parse 'one' into an int"),
    ],
)
def test_flags_that_are_misspelt_or_lack_their_type_are_one_line(config, typed, line, capsys) -> None:
    assert run_cli(lambda: draccus.parse(config, args=typed) and None)() == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith(f"error: {line}")


def test_a_misspelt_flag_that_is_required_is_named(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine-diagnose", "--recording=presses", "--output-dir=out"])
    assert diagnose.main() == 2
    told = "error: the following arguments are required: --output_dir; did you mean --output_dir?\n"
    assert capsys.readouterr().err == told


def test_settings_that_a_file_should_not_have_are_told_with_the_file(monkeypatch, tmp_path, capsys) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("num_epsodes: 3\n")
    monkeypatch.setattr(sys, "argv", ["command", f"--config_path={file}"])
    assert run_cli(lambda: draccus.parse(Flags, file, args=[]) and None)() == 2
    assert capsys.readouterr().err == (f"error: {file}: `num_epsodes`: no such setting; is it misspelt?\n")


def test_a_group_without_its_type_in_a_file_is_told_as_such(monkeypatch, tmp_path, capsys) -> None:
    file = tmp_path / "train_config.json"  # as lerobot-train writes it
    file.write_text('{"env": null}')
    assert run_cli(lambda: draccus.parse(FinetunePipelineConfig, file, args=[]) and None)() == 2
    told = "error: in the file of --config_path, a group that needs its type, as in env: {type: vtrefine}, is"
    assert capsys.readouterr().err == f"{told} None\n"


def test_a_network_that_does_not_answer_is_one_line(capsys) -> None:
    def upload() -> None:
        raise httpx.ConnectError("[Errno -2] Name or service not known")

    assert run_cli(upload)() == 2
    error = capsys.readouterr().err
    assert error.startswith("error: the network did not answer ([Errno -2] Name or service not known)")
    assert error.count("\n") == 1


def test_an_interrupt_says_how_to_go_on(capsys) -> None:
    def long_work() -> None:
        with after_interrupt("the same command goes on"):
            raise KeyboardInterrupt

    assert run_cli(long_work)() == 130
    assert capsys.readouterr().err == "interrupted: the same command goes on\n"


def test_weights_on_a_full_disk_are_one_line(capsys) -> None:
    def save() -> None:
        raise safetensors.SafetensorError("Error while serializing: No space left on device (os error 28)")

    assert run_cli(save)() == 2
    assert capsys.readouterr().err.startswith("error: the disk is full; free some space")


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
        RuntimeError("Failed to allocate 762132 bytes on device 'cuda:0'"),  # Warp's
    ],
    ids=["torch", "warp"],
)
def test_a_gpu_without_memory_is_one_line(error: Exception, capsys) -> None:
    assert failing(error)() == 2
    told = capsys.readouterr().err
    assert told.startswith("error: the GPU's memory is full: simulate fewer worlds")
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ValueError("std::bad_alloc"),  # MuJoCo's
        RuntimeError(
            "[enforce fail at alloc_cpu.cpp:117] . DefaultCPUAllocator: can't allocate memory: 8 GB"
        ),
    ],
    ids=["NumPy", "MuJoCo", "torch"],
)
def test_too_little_memory_is_one_line(error: Exception, capsys) -> None:
    assert failing(error)() == 2
    told = capsys.readouterr().err
    assert told.startswith("error: the memory is full: simulate or train on less at once")
    assert told.count("\n") == 1


@pytest.mark.parametrize("lines", [1, 100_000], ids=["at its end", "while it writes"])
def test_a_command_whose_reader_has_seen_enough_ends_without_a_word(lines) -> None:
    command = (
        "import sys; from lerobot_vtrefine.cli.errors import run_cli;"
        f"sys.exit(run_cli(lambda: sys.stdin.read() and print('line\\n' * {lines}))())"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", command], text=True, **pipes) as process:
        process.stdout.close()
        process.stdin.write("go on")
        process.stdin.close()
        told = process.stderr.read()
    assert (process.returncode, told) == (141, "")


def test_another_pipe_that_breaks_is_told(capsys) -> None:
    assert failing(BrokenPipeError(errno.EPIPE, "Broken pipe"))() == 2
    assert capsys.readouterr().err == "error: [Errno 32] Broken pipe\n"
