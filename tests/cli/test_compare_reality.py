"""Comparing simulators: equal budgets, nothing trained in the stand-in reality, honest differences."""

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture(scope="module")
def scripts():
    sys.path.insert(0, str(SCRIPTS))
    import compare_reality
    import press_reality

    yield compare_reality, press_reality
    sys.path.remove(str(SCRIPTS))


@pytest.fixture
def budget(scripts, tmp_path):
    compare, _ = scripts
    budget = compare.Budget(tmp_path, tuple(compare.REALITIES), (3, 4), "cpu", 4, 20, 1, 4, 4, 4, 8, {})
    compare.write_worlds(budget)
    for name in budget.realities:  # as if diagnosed
        budget.diagnosis(name).mkdir(parents=True)
        compare.PLAIN.save(budget.diagnosis(name) / "sensor_model.json")
    return budget


def flags_of(stage):
    return dict(word[2:].partition("=")[::2] for word in shlex.split(stage.line)[1:] if word.startswith("--"))


def test_fine_tunings_differ_in_the_simulator_alone(scripts, budget):
    compare, _ = scripts
    _, policies = compare.lanes(budget)
    stages = {
        stage.name: stage for lane in policies.values() for stage in lane if stage.name.startswith("finetune")
    }
    assert len(stages) == 6  # three simulators, two seeds
    kept = []
    for stage in stages.values():
        flags = flags_of(stage)
        assert "env.reality" not in flags
        kept.append({k: v for k, v in flags.items() if k not in ("env.sensor_model", "output_dir", "seed")})
    assert all(flags == kept[0] for flags in kept)
    assert len({flags_of(stage)["env.sensor_model"] for stage in stages.values()}) == 3
    assert len({flags_of(stage)["seed"] for stage in stages.values()}) == 2


def test_evaluations_use_the_same_episodes_and_valid_environments(scripts, budget):
    from lerobot_vtrefine.cli.pipeline.child_configs import parse_env

    compare, _ = scripts
    _, policies = compare.lanes(budget)
    stages = [stage for lane in policies.values() for stage in lane if stage.name.startswith("eval")]
    assert len(stages) == 2 * len(compare.evaluations(budget)) == 20
    seeds = {(flags_of(stage)["seed"], stage.name[-1]) for stage in stages}
    assert len(seeds) == 2
    for stage in stages:
        env = {key[4:]: value for key, value in flags_of(stage).items() if key.startswith("env.")}
        assert ("reality" in env) == ("_in_real_" in stage.name)
        assert ("sensor_model" in env) != ("reality" in env)
        config = parse_env({k: v for k, v in env.items() if k != "type"})
        names = {item.name for item in (config.hidden.sensor_model or compare.PLAIN).stages}
        assert ("row_sharing" in names) == ("in_real_row_sharing" in stage.name)


def test_every_lane_can_run_on_its_own(scripts, budget):
    compare, _ = scripts
    before, policies = compare.lanes(budget)
    assert len(before) == 3
    assert len(policies) == 8
    for stages in (before | policies).values():
        names = [stage.name for stage in stages]
        assert len(set(names)) == len(names)
        for index, stage in enumerate(stages):
            assert set(stage.needs) <= set(names[:index])
            assert "/" not in stage.name


def test_difference_is_paired_and_named_honestly(scripts):
    compare, _ = scripts
    rng = np.random.default_rng(0)
    plain = list(rng.random(200) < 0.5)
    better = [a or b for a, b in zip(plain, rng.random(200) < 0.4, strict=True)]
    gain = compare.paired_difference(plain, better)
    assert gain["ci95"][0] > 0.1
    assert compare.paired_difference(plain, plain) == {"mean": 0.0, "ci95": [0.0, 0.0]}

    rate = {"rate": 0.5, "ci95": [0.4, 0.6], "episodes": 200}
    keys = ("imitation in reality", "imitation in the plain simulator", "plain in reality")
    keys += ("plain in its own simulator", "diagnosed in reality", "diagnosed in its own simulator")
    row = dict.fromkeys(keys, rate) | {"verdict": {"status": "explained", "causes": ["latency"]}}
    for interval, words in (
        ((0.1, 0.3), "pays"),
        ((-0.1, 0.3), "makes no difference"),
        ((-0.3, -0.1), "costs"),
    ):
        difference = {"mean": float(np.mean(interval)), "ci95": list(interval)}
        text = compare.as_text({"x": row | {"diagnosed_minus_plain_in_reality": difference}})
        assert f"(explained: latency) {words}" in text


def test_presses_follow_the_contract_and_the_hidden_pad(scripts, budget):
    from lerobot_vtrefine.diagnose.prediction import predict_trial
    from lerobot_vtrefine.diagnose.quality import check_quality
    from lerobot_vtrefine.diagnose.recordings import read_recording_set

    compare, press = scripts
    reality = budget.output_dir / compare.folder_name(budget.realities[0]) / "reality.json"
    press.record(reality, budget.output_dir / "presses", trials=4, seed=1)
    recordings = read_recording_set(budget.output_dir / "presses")
    assert [len(trial.time_s) for trial in recordings.trials] == [120] * 4
    assert len({trial.condition for trial in recordings.trials}) == 2
    assert check_quality(recordings)[1] == []

    hidden = press.this_pad(compare.REALITIES[budget.realities[0]](), np.random.default_rng(1))
    for trial in recordings.trials:
        pressed = trial.raw - press.idle_map(hidden).ravel()
        assert pressed.max() > 20
        error, plain_error = (
            np.sqrt(np.mean((predict_trial(model, trial, press.LAYOUT) - trial.raw) ** 2))
            for model in (hidden, compare.PLAIN.with_stage(hidden.find("idle")))
        )
        assert error < 0.5 * plain_error


def test_a_reality_without_sensor_model_cannot_be_pressed(scripts, tmp_path):
    _, press = scripts
    (tmp_path / "reality.json").write_text(json.dumps({"schema": "vtrefine/reality@1"}))
    with pytest.raises(ValueError, match="has no sensor model"):
        press.record(tmp_path / "reality.json", tmp_path / "presses", 4, 0)
