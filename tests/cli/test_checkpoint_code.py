"""A checkpoint that names a command in its processor files: no stock command and none of ours runs it."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from loaded_process import LoadedProcess
from tiny_commands import TINY_ENV

COMMAND = "import runpy, sys; sys.argv[:] = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
"""A console script with its arguments."""


def poisoned(checkpoint: Path, folder: Path, marker: Path) -> Path:
    """A copy of ``checkpoint`` whose preprocessor would create ``marker``."""
    shutil.copytree(checkpoint, folder)
    file = folder / "policy_preprocessor.json"
    saved = json.loads(file.read_text())
    saved["steps"].insert(0, {"class": "subprocess.Popen", "config": {"args": ["touch", str(marker)]}})
    file.write_text(json.dumps(saved))
    return folder


def test_stock_eval_and_train_refuse_it(
    checkpoint: Path, demos: Path, tmp_path: Path, loaded: LoadedProcess
) -> None:
    marker = tmp_path / "ran"
    policy = (f"--policy.path={poisoned(checkpoint, tmp_path / 'policy', marker)}", "--policy.device=cpu")
    data = ("--dataset.repo_id=local/vtrefine_demos", f"--dataset.root={demos}", "--num_workers=0")
    train = ("--steps=1", "--batch_size=4", "--wandb.enable=false", "--policy.push_to_hub=false")
    evaluate = ("--eval.n_episodes=1", "--eval.batch_size=1", "--env.episode_steps=5", *TINY_ENV)
    for name, arguments in (("eval", evaluate), ("train", (*data, *train))):
        program = str(Path(sys.executable).with_name(f"lerobot-{name}"))
        done = loaded.run(COMMAND, program, *policy, *arguments, f"--output_dir={tmp_path / name}")
        assert done.returncode == 1
        told = done.stderr.splitlines()[-1]
        assert "policy_preprocessor.json of" in told, done.stderr[-3000:]
        assert "names the class 'subprocess.Popen'" in told
    assert not marker.exists()


def test_finetune_refuses_it_in_one_line(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from lerobot_vtrefine.cli.finetune import main

    marker = tmp_path / "ran"
    policy = poisoned(checkpoint, tmp_path / "policy", marker)
    flags = (f"--policy.path={policy}", f"--output_dir={tmp_path / 'out'}", *TINY_ENV)
    monkeypatch.setattr(sys, "argv", ["vtrefine-finetune", *flags])
    assert main() == 2
    assert not marker.exists()
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("error: policy_preprocessor.json of")
    assert "'subprocess.Popen'" in line
