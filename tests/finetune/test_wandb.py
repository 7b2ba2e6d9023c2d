"""Logging of ``vtrefine-finetune`` to Weights & Biases: offline for real, and what it says when it cannot."""

import json
import sys
import time
from pathlib import Path

import pytest
from tiny_policy import ReachEnv, save_tiny_checkpoint

from lerobot_vtrefine.cli.finetune import main
from lerobot_vtrefine.finetune import pipeline
from lerobot_vtrefine.finetune.logger import read_progress


@pytest.fixture
def finetune(tmp_path, monkeypatch):
    """Runs the command on a tiny policy without a simulator, with wandb on; returns its exit status."""
    start = save_tiny_checkpoint(tmp_path / "start")
    monkeypatch.setattr(pipeline, "make_decision_env", lambda env, num_envs, *rest: ReachEnv(num_envs))
    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.setenv("WANDB_ERROR_REPORTING", "false")
    monkeypatch.setenv("NETRC", str(tmp_path / "no_netrc"))  # nobody is logged in

    def run(output: Path, iterations: int, *arguments: str) -> int:
        named = (f"--policy.path={start}", f"--output_dir={output}", f"--dppo.iterations={iterations}")
        dppo = ("--dppo.type=small", "--dppo.num_envs=4", "--dppo.epochs=1", "--dppo.critic_width=16")
        rest = ("--env.type=vtrefine", "--eval.n_episodes=4", "--save_freq=1", "--wandb.enable=true")
        monkeypatch.setattr("sys.argv", ["vtrefine-finetune", *named, *dppo, *rest, *arguments])
        return main()

    return run


def records(path: Path) -> list:
    """The records of one offline run; wandb's own process may write the last of them after ``finish``."""
    from wandb.proto.wandb_internal_pb2 import Record
    from wandb.sdk.internal.datastore import DataStore

    deadline = time.monotonic() + 60
    found: list = []
    while not any(record.WhichOneof("record_type") == "exit" for record in found):
        assert time.monotonic() < deadline, f"{path}: no end of the run after a minute"
        time.sleep(0.1)
        store, found = DataStore(), []
        try:
            store.open_for_scan(str(path))
            while (data := store.scan_data()) is not None:
                found.append(Record.FromString(data))
        except AssertionError:  # half a record: read again
            continue
    return found


def logged(output: Path) -> list[tuple[str, dict[int, dict[str, float]]]]:
    """(run id, metrics by iteration) of every offline run below ``output``, in the order of their start."""
    runs = []
    for path in sorted(output.glob("wandb/offline-run-*/*.wandb")):
        history, name = {}, ""
        for record in records(path):
            if record.WhichOneof("record_type") == "run":
                name = record.run.run_id
            if record.WhichOneof("record_type") == "history":
                row = {
                    (item.key or "/".join(item.nested_key)): json.loads(item.value_json)
                    for item in record.history.item
                }
                history[int(row["_step"])] = row
        runs.append((name, history))
    return runs


def test_offline_runs_hold_every_metric_and_are_continued(finetune, tmp_path):
    output = tmp_path / "run"
    assert finetune(output, 1, "--wandb.mode=offline") == 0
    assert finetune(output, 2, "--wandb.mode=offline", "--resume=true") == 0
    (first, before), (second, after) = logged(output)
    assert first == second == (output / "wandb_run_id").read_text()
    assert (sorted(before), sorted(after)) == ([0, 1], [2])
    rows = read_progress(output)
    for step, row in (before | after).items():
        expected = {key: value for key, value in rows[step].items() if key != "iteration"}
        assert {key: row[key] for key in expected} == pytest.approx(expected)


def test_without_login_one_line_names_the_way_out(finetune, tmp_path, capsys):
    assert finetune(tmp_path / "run", 1) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("error: Weights & Biases: ")
    assert "--wandb.mode=offline" in line


def test_without_the_package_one_line_names_it(finetune, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert finetune(tmp_path / "run", 1) == 2
    assert "needs the package wandb" in capsys.readouterr().err.strip().splitlines()[-1]
