"""Comparing simulators: equal budgets, nothing trained in the stand-in reality, honest differences."""

import json
import subprocess
from dataclasses import replace

import compare_reality as script
import numpy as np
import pytest
import yaml
from reality.budget import Budget, folder_name, recipe, write_worlds
from reality.hidden import PLAIN, REALITIES, of_robot
from reality.lanes import evaluations, lanes, needed
from reality.outcome import compare, compare_one, reality_rows, results_path
from reality.stages import finetune_dir, finetune_stage, imitation_stages, motion_stage, output_name
from reality.telling import as_text

from lerobot_vtrefine.cli.results.collect import ORIGIN
from lerobot_vtrefine.cli.results.tables import table
from lerobot_vtrefine.diagnose.joints.model import RobotModel
from lerobot_vtrefine.diagnose.pad import stand_in_rig as press
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.finetune.logger import ProgressLog
from lerobot_vtrefine.robots.config_vtrefine_sim import VtRefineSimConfig
from lerobot_vtrefine.tactile.model import SensorModel


@pytest.fixture
def budget(tmp_path):
    budget = Budget(tmp_path, tuple(REALITIES), (3, 4), "cpu", 4, 20, 1, 4, 4, 4, 8, 3, {})
    write_worlds(budget)
    for name in budget.realities:  # as if diagnosed
        budget.diagnosis(name).mkdir(parents=True)
        model = budget.diagnosis(name) / "sensor_model.json"
        if of_robot(name):
            RobotModel.default(ALOHA.joint_names).save(model)
        else:
            PLAIN.save(model)
    return budget


def flags_of(stage):
    return dict(word[2:].partition("=")[::2] for word in stage.command[1:] if word.startswith("--"))


def test_what_is_learnt_differs_in_the_simulator_alone(budget):
    _, policies = lanes(budget)
    for kind, count in (("record", 5), ("pretrain", 5), ("finetune", 10)):  # five simulators, two seeds
        stages = {
            s.name: s
            for lane in policies.values()
            for s in lane
            if s.name.startswith((f"{kind}_plain", f"{kind}_diagnosed"))
        }
        assert len(stages) == count
        differ = ("env.sensor_model", "env.reality", "output_dir", "root", "dataset.root", "policy.path")
        kept = []
        for stage in stages.values():
            flags = flags_of(stage)
            assert "/diagnosis/" in flags.get("env.reality", "/diagnosis/")  # never the hidden one
            world = stage.name.removeprefix(f"{kind}_").removesuffix("_3").removesuffix("_4")
            own = (flags.get(name, world) for name in ("dataset.root", "policy.path", "root"))
            assert all(world in path for path in own)
            kept.append({k: v for k, v in flags.items() if k not in differ})
        assert len({flags["seed"] for flags in kept}) == count // 5
        assert all({**flags, "seed": 0} == {**kept[0], "seed": 0} for flags in kept)
    models = {(flags_of(s)["env.sensor_model"], flags_of(s).get("env.reality")) for s in stages.values()}
    assert len(models) == 5


def test_evaluations_use_the_same_episodes_and_valid_environments(budget):
    from lerobot_vtrefine.cli.pipeline.child_configs import parse_env

    policies = lanes(budget)[1]
    stages = [stage for lane in policies.values() for stage in lane if stage.name.startswith("eval")]
    assert len(stages) == 2 * len(evaluations(budget)) == 26
    seeds = {(flags_of(stage)["seed"], stage.name[-1]) for stage in stages}
    assert len(seeds) == 2
    for stage in stages:
        env = {key[4:]: value for key, value in flags_of(stage).items() if key.startswith("env.")}
        assert ("reality.json" in env.get("reality", "")) == ("_in_real_" in stage.name)
        config = parse_env({k: v for k, v in env.items() if k != "type"})
        assert (config.hidden.sensor_model is None) == ("sensor_model" in env)
        names = {item.name for item in (config.hidden.sensor_model or PLAIN).stages}
        assert ("row_sharing" in names) == ("in_real_row_sharing" in stage.name)
        assert bool(config.hidden.robot.backlash_rad) == ("in_real_control_latency" in stage.name)


def test_every_lane_can_run_on_its_own(budget):
    before, policies = lanes(budget)
    assert [len(before), len(policies)] == [5, 10]
    assert len(before | policies) == 15
    for stages in (before | policies).values():
        names = [stage.name for stage in stages]
        assert len(set(names)) == len(names)
        for index, stage in enumerate(stages):
            assert set(stage.needs) <= set(names[:index])
            assert "/" not in stage.name


def leave_results(budget, rates, seeds):
    """Evaluations as LeRobot leaves them: success of these shares of four episodes, by (trained, world)."""
    for pair in evaluations(budget):
        for seed in seeds:
            done = [k < rates.get(pair, 1) for k in range(4)]
            path = results_path(budget, *pair, seed)
            path.parent.mkdir(parents=True)
            path.write_text(json.dumps({"per_task": [{"metrics": {"successes": done}}]}))
    for name in budget.realities:
        verdict = {"status": "explained", "causes": [{"name": "backlash"}], "heldout": None}
        (budget.diagnosis(name) / "verdict.json").write_text(json.dumps(verdict))


def test_results_say_what_reality_costs_and_what_diagnosis_brings_back(budget):
    name = "control_latency+backlash"
    rates = {("plain", "plain"): 3, (f"diagnosed:{name}", f"real:{name}"): 2}
    leave_results(budget, rates, budget.seeds)
    results = compare(budget)
    row = results[name]
    assert row["plain in its own simulator"]["rate"] == 0.75
    assert row["reality_minus_simulator"] == {"mean": -0.5, "ci95": [-0.5, -0.5]}
    assert row["diagnosed_minus_plain"] == {"mean": 0.25, "ci95": [0.25, 0.25]}
    text = as_text(results)
    assert "(explained: backlash) pays, 25 % [25, 25] over 2 seeds of 4 episodes" in text
    assert text.count("makes no difference that these seeds can show") == 3
    alone = as_text({name: compare_one(budget, name, [3])})
    assert "changes by -50 % (one seed) in the stand-in reality" in alone


def test_comparison_becomes_rows_of_the_results(budget):
    name = "control_latency+backlash"
    leave_results(budget, {("plain", "plain"): 3}, budget.seeds)
    folder = finetune_dir(budget, "plain", 4)
    folder.mkdir()
    ProgressLog(folder, 0, None).add(3, {"success": 0.5, "env_steps": 400.0})
    origin = {"commit": "0123abc", "command": None, "machine": "2 cores"}
    rows = [row for row, _ in reality_rows(budget.output_dir, origin)]
    assert len({row.key for row in rows}) == len(rows) == 4 * 4 * 2
    (row,) = (r for r in rows if r.task == name and r.seed == 4 and r.variant == "plain in its own simulator")
    assert (row.success, row.episodes, row.iterations, row.env_steps) == (0.75, 4, 3, 400)
    assert row.extra == {"diagnosis": "backlash"}
    text = table("reality", rows)
    hidden = "commands 0.1 s late, 20 mrad of play in all arm joints"
    quarter, most = "25 [25, 25] (25, 25)", "75 [75, 75] (75, 75)"
    assert f"| {hidden} | backlash | the plain simulator | {quarter} | {most} |" in text
    assert f"| | | the diagnosed simulator | {quarter} | {quarter} |" in text


def test_a_task_of_its_own_brings_its_encoder_and_its_name(budget, tmp_path, monkeypatch):
    flags = ["--task=cross_gentle", "--recipe=pads", '--dppo={"encoder": "trained"}', "--jobs=2"]
    monkeypatch.setattr("sys.argv", ["compare_reality.py", f"--output_dir={tmp_path}", *flags])
    _, own = script.parse()
    encoder, record, pretrain = imitation_stages(own, "plain")
    for stage in (encoder, record, pretrain):
        assert flags_of(stage).get("env.pair", "cross") == "cross"
    assert flags_of(record)["env.randomization.part_friction"] == "[0.2, 0.45]"
    assert flags_of(encoder)["env.sensor_model"].endswith("plain/sensor_model.json")
    assert flags_of(pretrain)["policy.pretrained_encoder"] == str(encoder.output)
    assert set(pretrain.needs) == {record.name, encoder.name}
    assert flags_of(finetune_stage(own, "plain", 0))["dppo.encoder"] == "trained"
    other = f"diagnosed:{own.realities[0]}"
    encoder, record, pretrain = imitation_stages(own, other)
    assert encoder.needs == record.needs == (output_name(own.realities[0]),)
    model = str(own.diagnosis(own.realities[0]) / "sensor_model.json")
    assert flags_of(encoder)["env.sensor_model"] == flags_of(record)["env.sensor_model"] == model
    assert flags_of(pretrain)["policy.pretrained_encoder"] == str(encoder.output)
    leave_results(budget, {}, budget.seeds)
    rows = [row for row, _ in reality_rows(budget.output_dir, dict.fromkeys(ORIGIN), "cross_gentle")]
    assert "| cross, 2 mm, 5 N at most (cross_gentle): row sharing, hysteresis | backlash |" in table(
        "reality", rows
    )


def test_a_gpu_that_is_not_there_is_told_before_anything_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("sys.argv", ["compare_reality.py", f"--output_dir={tmp_path}", "--device=cuda"])
    monkeypatch.setattr(script, "run_lanes", lambda *_: pytest.fail("it went on"))
    assert script.main() == 2
    assert "--device=cuda: no CUDA GPU with a driver here" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_unfinished_seeds_are_left_out(budget):
    leave_results(budget, {}, budget.seeds)
    first, *others = budget.realities
    results_path(budget, f"diagnosed:{first}", f"real:{first}", 4).unlink()
    results = compare(budget)
    assert results[first]["seeds"] == [3]
    assert all(results[name]["seeds"] == [3, 4] for name in others)
    for seed in budget.seeds:
        results_path(budget, "plain", "plain", seed).unlink()
    assert compare(budget) == {}


def test_every_lane_is_this_script_again_and_one_that_fails_leaves_the_others_compared(
    budget, monkeypatch, capsys
):
    """And what a lane's process runs is the lane's stages, of the same flags."""
    started = {}

    def run_all(commands, jobs, needs):
        started.update(commands)
        assert jobs == 2
        assert {name.name: [world.name for world in worlds] for name, worlds in needs.items()} == needed(
            *lanes(budget)
        )
        leave_results(budget, {}, [3])
        raise subprocess.CalledProcessError(3, ["lane"])

    flags = [f"--output_dir={budget.output_dir}", "--seeds", "3", "4", "--jobs=2"]
    monkeypatch.setattr("sys.argv", ["compare_reality.py", *flags])
    monkeypatch.setattr(script, "run_all", run_all)
    assert script.main() == 3
    before, policies = lanes(budget)
    assert {folder.name for folder in started} == set(before | policies)
    for folder, (_, path, *again) in started.items():
        assert path == script.__file__
        assert again == [*flags, f"--lane={folder.name}"]
    assert "over 1 seeds" in capsys.readouterr().out
    kept = json.loads((budget.output_dir / "comparison.json").read_text())
    assert all(kept[name]["seeds"] == [3] for name in budget.realities)
    assert (budget.output_dir / "comparison.md").is_file()

    ran = []
    monkeypatch.setattr(script.StageRunner, "run", lambda runner: ran.extend(runner.stages))
    name = "policy_plain_4"
    monkeypatch.setattr("sys.argv", ["compare_reality.py", *flags, f"--lane={name}"])
    assert script.main() == 0
    assert [stage.name for stage in ran] == [stage.name for stage in policies[name]]


def test_every_policy_waits_for_its_own_simulator_only(budget):
    before, policies = lanes(budget)
    assert set(before) == {"plain", *(folder_name(f"diagnosed:{name}") for name in budget.realities)}
    for name, worlds in needed(before, policies).items():
        assert name.rpartition("_")[0] == f"policy_{worlds[0]}"
        assert len(worlds) == 1


def test_presses_follow_the_contract_and_the_hidden_pad(budget):
    from lerobot_vtrefine.diagnose.pad.prediction import predict_trial
    from lerobot_vtrefine.diagnose.quality import check_quality
    from lerobot_vtrefine.diagnose.recordings import read_recording_set

    reality = budget.output_dir / folder_name(budget.realities[0]) / "reality.json"
    press.record(reality, budget.output_dir / "presses", trials=4, seed=1)
    recordings = read_recording_set(budget.output_dir / "presses")
    assert [len(trial.time_s) for trial in recordings.trials] == [120] * 4
    assert len({trial.condition for trial in recordings.trials}) == 2
    assert check_quality(recordings)[1] == []

    pad = SensorModel.from_dict(REALITIES[budget.realities[0]]()["sensor_model"])
    hidden = press.this_pad(pad, np.random.default_rng(1))
    for trial in recordings.trials:
        pressed = trial.raw - press.idle_map(hidden).ravel()
        assert pressed.max() > 20
        error, plain_error = (
            np.sqrt(np.mean((predict_trial(model, trial, press.LAYOUT) - trial.raw) ** 2))
            for model in (hidden, PLAIN.with_stage(hidden.find("idle")))
        )
        assert error < 0.5 * plain_error


def test_a_reality_without_sensor_model_cannot_be_pressed(tmp_path):
    (tmp_path / "reality.json").write_text(json.dumps({"schema": "vtrefine/reality@1"}))
    with pytest.raises(ValueError, match="has no sensor model"):
        press.record(tmp_path / "reality.json", tmp_path / "presses", 4, 0)


def test_a_hidden_robot_is_moved_by_the_stock_recorder(budget):
    """In its own world, which the simulated robot accepts: without the back end of many worlds."""
    own = replace(budget, env={**budget.env, "backend": "warp", "episode_steps": 41})
    flags = flags_of(motion_stage(own, "control_latency+backlash"))
    robot = VtRefineSimConfig(env=yaml.safe_load(flags["robot.env"]), seed=int(flags["robot.seed"]))
    env = robot.simulation()
    assert env.hidden.robot is not None
    assert env.hidden.robot.control_latency_s == 0.1
    assert env.scene_config.start == "table"
    assert env.task_config.episode_steps / env.fps == float(flags["dataset.episode_time_s"])
    assert (flags["teleop.input"], flags["dataset.num_episodes"]) == ("excitation", str(own.motions))


def test_a_run_is_planned_before_anything_is_diagnosed(tmp_path):
    """And its demonstrations are recorded in the simulator that the diagnosis will leave."""
    budget = Budget(tmp_path, tuple(REALITIES), (3,), "cpu", 4, 20, 1, 4, 4, 4, 8, 3, {})
    write_worlds(budget)
    before, policies = lanes(budget)
    assert len(policies) == 1 + len(budget.realities)
    for name in budget.realities:
        world = f"diagnosed:{name}"
        lane = {stage.name: flags_of(stage) for stage in before[folder_name(world)]}
        given = "env.reality" if of_robot(name) else "env.sensor_model"
        record = lane[folder_name("record", world)]
        assert record[given] == str(budget.diagnosis(name) / "sensor_model.json")
        assert record["root"] == str(recipe(budget, 3, world).dataset_dir)
