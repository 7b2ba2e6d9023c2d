"""What ``vtrefine-finetune`` makes of folders that hold part of a run."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_policy import ReachEnv, save_tiny_checkpoint

from lerobot_vtrefine.cli.finetune import main
from lerobot_vtrefine.finetune import pipeline
from lerobot_vtrefine.finetune.checkpoint import claimed
from lerobot_vtrefine.finetune.logger import read_progress

SMALL = (
    *("--env.type=vtrefine", "--eval.n_episodes=2", "--eval_freq=1", "--save_freq=1", "--dppo.type=small"),
    *("--dppo.num_envs=2", "--dppo.epochs=1", "--dppo.minibatch_decisions=6", "--dppo.critic_width=8"),
    "--dppo.critic_warmup=1",
)
Finetune = Callable[..., int]


@pytest.fixture
def finetune(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Finetune:
    """Runs the command into a folder; its exit status."""
    start = save_tiny_checkpoint(tmp_path / "start")
    monkeypatch.setattr(pipeline, "make_decision_env", lambda env, num_envs, *rest: ReachEnv(num_envs))

    def run(output: Path, iterations: int, *flags: str) -> int:
        named = [f"--policy.path={start}", f"--output_dir={output}", f"--dppo.iterations={iterations}"]
        monkeypatch.setattr("sys.argv", ["vtrefine-finetune", *named, *SMALL, *flags])
        return main()

    return run


@pytest.mark.parametrize("iterations", [2, 3])
def test_nothing_is_told_of_the_whole_run_without_its_curve(
    finetune: Finetune, tmp_path: Path, capsys: pytest.CaptureFixture[str], iterations: int
) -> None:
    run, moved = tmp_path / "run", tmp_path / "moved"
    assert finetune(run, 2) == 0
    shutil.copytree(run / "checkpoints", moved / "checkpoints", symlinks=True)
    capsys.readouterr()
    assert finetune(moved, iterations, "--resume=true") == 0
    assert [row["iteration"] for row in read_progress(moved)] == [3.0][: iterations - 2]
    told, policy, _ = capsys.readouterr().out.splitlines()[-3:]
    assert told.startswith(f"{moved / 'progress.csv'} does not go back to the start")
    assert policy == f"policy: {moved}/checkpoints/last/pretrained_model"


@pytest.mark.parametrize("flags", [(), ("--resume=true",)])
def test_a_folder_in_which_another_run_goes_on_is_left_alone(
    finetune: Finetune, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: tuple[str, ...]
) -> None:
    run = tmp_path / "run"
    with claimed(run):  # before its first checkpoint
        (run / "progress.csv").write_text("iteration,return\n1,0.5\n")
        assert finetune(run, 1, *flags) == 2
        told = capsys.readouterr().err.splitlines()[-1]
        assert told == f"error: another run goes on in {run}: end it first, or choose another --output_dir"
        assert [path.name for path in run.iterdir()] == ["progress.csv"]
        assert read_progress(run) == [{"iteration": 1.0, "return": 0.5}]
    assert finetune(run, 1, *flags) == 0


def test_a_checkpoint_is_on_the_disk_before_it_has_its_name(
    finetune: Finetune, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[Path] = []
    rename, fsync = Path.rename, os.fsync

    def synchronise(descriptor: int) -> None:
        synced.append(Path(f"/proc/self/fd/{descriptor}").readlink())
        fsync(descriptor)

    def named(self: Path, target: Path) -> Path:
        if self.name == "000001.partial":
            written = {path for path in self.rglob("*") if path.is_file()}
            assert {path.name for path in written} >= {"model.safetensors", "dppo_state.safetensors"}
            assert written <= set(synced)
            synced.append(target)
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", synchronise)
    monkeypatch.setattr(Path, "rename", named)
    run = tmp_path / "run"
    assert finetune(run, 1) == 0
    at = synced.index(run / "checkpoints" / "000001")
    assert run / "checkpoints" in synced[at:]
