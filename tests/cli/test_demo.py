"""The demo: its command lines, results.json and report, with stand-ins for the commands that take minutes."""

import json
import re
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lerobot_vtrefine import shipped
from lerobot_vtrefine.cli import demo
from lerobot_vtrefine.cli.arguments import flags
from lerobot_vtrefine.cli.pipeline.demo_config import ENCODERS, LARGEST_SEED, DemoConfig, default_env
from lerobot_vtrefine.cli.pipeline.demo_stages import demo_stages
from lerobot_vtrefine.cli.report.results import verdict
from lerobot_vtrefine.cli.report.statistics import proportion, quantiles, wilson_interval
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS, TRAINING_SEEDS
from lerobot_vtrefine.pages.rates import Bar, Series, bar_chart, line_chart

ENV_FILES = Path(__file__).parents[2] / "configs" / "env"


@pytest.mark.usefixtures("fake_commands")
def test_demo_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--quick", "--videos=3", "--ablation_episodes=8", f"--output_dir={tmp_path / 'demo'}"]
    config = demo.parse_config(arguments)
    page = demo.run_demo(config).read_text(encoding="utf-8")
    results = json.loads((config.output_dir / "results.json").read_text())
    assert results["pretrain"]["success"] == 2
    assert results["pretrain"]["episodes"] == 8
    assert results["finetune"]["rate"] == 0.75
    assert results["finetune"]["ci95"] == [0.4093, 0.9285]
    assert results["pretrain"]["seeds"] == results["finetune"]["seeds"] == list(range(8_000_000, 8_000_008))
    assert results["finetune"]["failures"] == {"dropped": 2}
    assert set(results["ablations"]["finetune"]) == {"touch", "vision"}
    assert set(results["seconds"]) >= {"record", "pretrain", "finetune", "eval_finetune", "total"}
    assert results["summary"] in capsys.readouterr().out

    body = re.sub(r"<style>.*?</style>|<[^>]+>", "", page.split("<body>")[1], flags=re.DOTALL).strip()
    assert body.replace("\u00a0", " ").startswith(results["summary"])
    assert re.search(r"""(src|href)=["'](?!data:)""", page) is None, "the page needs another file"
    assert page.count("data:video/mp4;base64,") == 6
    assert page.count('class="pad"') == 4
    one_line = re.sub(r"\s*\\\s+", " ", page)
    for record in results["stages"]:
        assert record["command"].replace("'", "&#39;") in one_line
    assert "imitation, failure (dropped), seed 8000001" in page
    pair = page[page.index("The same episode before and after") : page.index("Success on unseen")]
    assert re.findall("<figcaption>(.*?)</figcaption>", pair) == [
        "imitation, failure (dropped), seed 8000001",
        "after DPPO, success, seed 8000001",
    ]
    assert "the policy needs neither sense" in page
    with Image.open(config.output_dir / "demo.gif") as gif:
        assert gif.width == demo.GIF_WIDTH
        gif.seek(gif.n_frames - 1)
        assert np.asarray(gif.convert("RGB")).mean() > 215  # the video's last frame, which tells the outcome


@pytest.mark.usefixtures("fake_commands")
def test_restart_continues(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = demo.parse_config(["--quick", f"--output_dir={tmp_path / 'demo'}"])
    demo.run_demo(config)
    capsys.readouterr()
    demo.run_demo(replace(config, finetune_iterations=3))
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("[")]
    assert ["done before" in line for line in lines] == [True, True, True, False, False]


def test_commands_are_those_of_users() -> None:
    names = [stage.command[0] for stage in demo_stages(DemoConfig())]
    assert names[:5] == [
        "vtrefine-record-demos",
        "lerobot-train",
        "lerobot-eval",
        "vtrefine-finetune",
        "lerobot-eval",
    ]
    assert names[5:] == ["lerobot-eval"] * 4
    visual = demo_stages(DemoConfig(modalities="visual"))
    assert [stage.name for stage in visual[5:]] == ["eval_pretrain_no_vision", "eval_finetune_no_vision"]


def test_another_body_comes_by_its_environments_file() -> None:
    kinova = f"--config_path={ENV_FILES / 'kinova_round_grasped.yaml'}"
    config = demo.parse_config(["--quick", kinova, "--recipe=cloud"])
    record, pretrain, *_ = (stage.command for stage in demo_stages(config))
    assert "--env.scene.embodiment=kinova" in record
    assert "--policy.observation.embodiment=kinova" in pretrain
    assert not [flag for flag in pretrain if "encoder" in flag]
    assert (config.num_demos, config.eval_episodes) == (4, 8)  # the file's eval: is lerobot-eval's


def test_every_body_sees_through_an_encoder_of_its_own() -> None:
    for body, encoder in ENCODERS.items():
        env = default_env() | {"scene": {"embodiment": body}}
        assert DemoConfig(env=env).policy["pretrained_encoder"] == encoder
        assert encoder.removeprefix(shipped.PREFIX) in shipped.encoders()
        mine = {"pretrained_encoder": "mine"}
        assert DemoConfig(env=env, policy=mine).policy["pretrained_encoder"] == "mine"
    with pytest.raises(ValueError, match="no encoder that was trained with toy: add --recipe=cloud"):
        DemoConfig(env=default_env() | {"scene": {"embodiment": "toy"}})


def test_flags_come_beside_the_recipes() -> None:
    config = demo.parse_config(["--policy={horizon: 16}", "--dppo={epochs: 3}"])
    assert (config.policy["horizon"], config.policy["fusion"]) == (16, "pads")
    assert (config.dppo, config.finetune_iterations) == (
        {"type": "small", "encoder": "frozen", "epochs": 3},
        20,
    )
    cloud = demo.parse_config(["--recipe=cloud"])
    assert (cloud.policy, cloud.finetune_iterations) == ({"preset": "small", "n_action_steps": 8}, 30)
    assert demo.parse_config(["--recipe=cloud", "--finetune_iterations=7"]).finetune_iterations == 7
    with pytest.raises(ValueError, match="--recipe=paper is unknown; choose from pads, cloud"):
        DemoConfig(recipe="paper")


def test_a_bank_of_starts_is_for_practice_alone() -> None:
    """Seeds of evaluations had drawn the very states that DPPO starts from."""
    config = demo.parse_config(["--env={start: table, start_bank: starts.npz}"])
    practised = [stage.name for stage in demo_stages(config) if "--env.start_bank" in stage.line]
    assert practised == ["finetune"]


def test_episodes_are_never_shared() -> None:
    """Evaluation seeds are unseen, within a run and between runs of different seeds; NumPy takes them all."""
    ranges = []
    for seed in (0, 1, 2, LARGEST_SEED):
        config = DemoConfig(seed=seed, finetune_iterations=1000, finetune_envs=6000)
        text = [stage.line for stage in demo_stages(config)]
        record, train, evaluate = (int(re.findall(r" --seed=(\d+)", text[index])[0]) for index in (0, 3, 2))
        train += TRAINING_SEEDS
        ranges += [
            (record, record + EVALUATION_SEEDS),
            (train, train + config.finetune_iterations * config.finetune_envs),
            (evaluate, evaluate + config.eval_episodes),
        ]
    assert all(end <= start for (_, end), (start, _) in pairwise(ranges))
    assert ranges[-1][1] < 2**32


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--finetune_envs=0", "--finetune_envs must be at least 1, got 0"),
        ("--pretrain_batch=0", "--pretrain_batch must be at least 1, got 0"),
        ("--ablation_episodes=-1", "--ablation_episodes must be at least 0, got -1"),
        ("--videos=-1", "--videos must be at least 0, got -1"),
        ("--seed=429", "--seed must lie in 0..428, got 429"),
        ("--finetune_envs=1000000", "--finetune_iterations times --finetune_envs must not exceed 6000000"),
        ("--dppo={tpye: small}", "--dppo: `tpye`: no such setting"),
        ("--dppo={type: smal}", "--dppo: Couldn't find a choice class for 'smal'"),
        ("--policy={n_action_step: 8}", "--policy: `n_action_step`: no such setting"),
        ("--policy={n_action_steps: 99}", "--policy: policy.n_action_steps=99 must be within"),
        ("--env={clearance_m: -1}", "--env: clearance_m must be above 0, got -1.0"),
        ("--env={read_every: 8}", "--env: `read_every`: no such setting"),
        ("--degradation={lateral_std_m: -1}", "--degradation: degradation.lateral_std_m must be"),
    ],
)
def test_bad_values_are_refused_at_once(
    flag: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine-demo", f"--output_dir={tmp_path / 'demo'}", flag])
    monkeypatch.setattr(demo, "run_demo", lambda config: pytest.fail("started"))
    assert demo.main() == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_headline_numbers_meet_the_promise() -> None:
    assert DemoConfig().eval_episodes >= 200


def test_flags() -> None:
    values = {"pair": "round", "limits": {"force_n": 20.0}, "video": True}
    assert flags("env", values) == ["--env.pair=round", "--env.limits.force_n=20.0", "--env.video=true"]


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (70, 140, "DPPO clearly improved"),
        (70, 100, "DPPO improved"),
        (70, 75, "DPPO did not clearly change"),
        (140, 70, "DPPO made worse"),
    ],
)
def test_verdict_says_what_happened(before: int, after: int, words: str) -> None:
    text = verdict(proportion(before, 200), proportion(after, 200))
    assert text.startswith(words)
    assert f"({before} of 200 episodes)" in text
    assert ("do not overlap" in text) == (words != "DPPO did not clearly change")


def test_wilson_interval() -> None:
    assert wilson_interval(0, 10)[0] == 0.0
    assert wilson_interval(10, 10)[1] == pytest.approx(1.0)
    with pytest.raises(ValueError, match="trials > 0"):
        wilson_interval(0, 0)


def test_quantiles_skip_what_was_not_measured() -> None:
    assert quantiles([None, 1.0, 3.0]) == {"median": 2.0, "p90": 2.8, "n": 2}
    assert quantiles([None]) is None


def test_charts_place_values() -> None:
    chart = bar_chart([Bar("x", 1.0, 0.0, 1.0)], "y")
    assert 'y="26.0" width="120.0" height="188.0"' in chart  # a rate of 1 fills the frame
    line = line_chart([Series("s", [(0, 0.0), (10, 1.0)])], "x", "y")
    assert 'points="56.0,214.0 326.0,26.0"' in line
    assert line_chart([Series("s", [])], "x", "y") == ""
