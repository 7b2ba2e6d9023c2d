"""The paper's tables: policies share demonstrations, become rows, and are not made twice."""

import argparse
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import compare_paper as script
import pytest
import yaml
from paper import trained
from paper.outcome import MORE_ROOM, failures, most_without_room, tell_of_room

from lerobot_vtrefine.cli.pipeline.stages import Stage
from lerobot_vtrefine.cli.results.rows import Run, read_rows
from lerobot_vtrefine.cli.results.tables import table

PAIRS = ("00007", "00581")


def common(folder: Path) -> list[str]:
    few = ["--episodes=8", "--device=cpu", "--seeds=0", "--mesh_dir=meshes"]
    return [*few, f"--output_dir={folder / 'out'}", f"--results={folder}"]


@pytest.fixture
def run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Run the script with these arguments beside the common ones; what it reported."""

    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["compare_paper.py", *common(tmp_path), *arguments])
        assert script.main() == 0
        return capsys.readouterr().err

    return run


def of(path: Path) -> dict[str, Run]:
    return {row.variant: row for row in read_rows(path) if isinstance(row, Run)}


def parse(arguments: list[str]) -> argparse.Namespace:
    return script.make_parser().parse_args(arguments)


@pytest.mark.usefixtures("fake_commands")
def test_policies_become_rows_of_the_papers_table_and_are_not_made_twice(
    run: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trained, "MODALITIES", ("visuo_tactile",))
    monkeypatch.setattr("lerobot_vtrefine.cli.pipeline.stages.commit", lambda: "0123abc")
    told = run("--pairs", "00186", "--recipe=pads", "--encoder=own", "--iterations=60")
    assert told.count("done before") == 2  # encoder and demonstrations, which random weights share
    paper = of(tmp_path / "paper_pads.json")
    assert set(paper) == {"imitation", "", "without pre-training"}
    assert (paper[""].success, paper[""].iterations) == (0.75, 60)
    assert paper["without pre-training"].iterations == 20
    assert paper["imitation"].extra["peak_force_n"] == 8.0
    assert {row.commit for row in paper.values()} == {"0123abc"}  # that trained, not that wrote the rows
    assert (paper[""].extra["picked_up"], paper[""].extra["failed_dropped"]) == (0.75, 0.25)
    told = failures({"episodes": 4, "picked_up": None, "failures": {"time-out": 1, "in-hand shift": 2}})
    assert told == {"failed_time_out": 0.25, "failed_in_hand_shift": 0.5}  # as vtrefine-finetune's columns
    assert not (tmp_path / "demonstrations_pads.json").exists()  # the paper's own number
    shown = table("paper_pads", [*paper.values()])
    assert "| DPPO after imitation | automate/00186 | - | 72 | 75 [41, 93] | 94 | - | +22 |" in shown
    shutil.rmtree(tmp_path / "out")  # another machine
    assert run("--pairs", "00186", "--recipe=pads", "--encoder=own", "--iterations=60") == ""
    for change, left in ((["--episodes=12"], 2), (["--scratch_iterations=21"], 1), (["--seeds=1"], 2)):
        options = parse([*common(tmp_path), "--pairs=00186", "--recipe=pads", "--iterations=60", *change])
        assert sum(not script.is_done(options, policy) for policy in script.chosen(options)) == left


@pytest.mark.usefixtures("fake_commands")
def test_an_imitation_that_was_judged_is_a_row_even_if_its_fine_tuning_never_ends(
    run: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trained, "MODALITIES", ("visuo_tactile",))
    run_stage = script.StageRunner._execute

    def cut_off(runner: script.StageRunner, stage: Stage, label: str) -> None:
        if stage.name.startswith("finetune"):
            raise ChildProcessError("the machine was given back")
        run_stage(runner, stage, label)

    asked = ["--pairs=00186", "--no_scratch"]
    with monkeypatch.context() as patch:
        patch.setattr(script.StageRunner, "_execute", cut_off)
        patch.setattr(sys, "argv", ["compare_paper.py", *common(tmp_path), *asked])
        assert script.main() != 0
    assert set(of(tmp_path / "paper.json")) == {"imitation"}
    assert run(*asked).count("done before") == 3  # demonstrations, imitation, its evaluation
    assert set(of(tmp_path / "paper.json")) == {"imitation", ""}


@pytest.mark.usefixtures("fake_commands")
def test_the_papers_own_network_has_tables_of_its_own_and_shares_the_demonstrations(
    run: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trained, "MODALITIES", ("visuo_tactile",))
    asked = ["--pairs", "00186", "--no_scratch", "--demonstrations", "10", "30"]
    run(*asked, "--recipe=pads")
    pads = [(tmp_path / f"{name}_pads.json").read_text() for name in ("paper", "demonstrations")]
    told = run(*asked)
    assert [line.split()[2] for line in told.splitlines() if "done before" in line] == [
        "demos_00186_0_10",
        "demos_00186_0_30",
    ]
    assert set(of(tmp_path / "paper.json")) == {"imitation", ""}
    assert set(of(tmp_path / "demonstrations.json")) == {
        "10 demonstrations, imitation",
        "10 demonstrations",
    }
    assert pads == [(tmp_path / f"{name}_pads.json").read_text() for name in ("paper", "demonstrations")]
    rows = [row for path in tmp_path.glob("*.json") for row in read_rows(path)]
    assert "| DPPO after imitation | automate/00186 | - | 72 | 75 [41, 93] |" in table("paper", rows)
    shown = table("demonstrations", rows)
    assert "| DPPO after imitation | 10 |" in shown
    assert "| DPPO after imitation | 30 |" in shown
    assert run(*asked) == ""


def test_the_papers_own_network_learns_as_a_whole_and_acts_as_often_as_the_other_on_a_gpu() -> None:
    options = parse(["--mesh_dir=meshes", "--pairs=00186", "--seeds=0", "--backend=warp"])
    for policy in script.chosen(options):
        _, imitation, *_, finetune, _ = script.stages(options, policy)
        assert imitation.command[0] == "lerobot-train"
        assert "--policy.n_action_steps=4" in imitation.line
        assert not any(word in imitation.line for word in ("encoder", "fusion", "feature_noise"))
        assert "--dppo.encoder" not in finetune.line


def test_pairs_side_by_side_wait_for_their_own_encoder_only(
    run: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[list[str], dict[str, list[str]]]] = []

    def note(commands: dict[Path, list[str]], _jobs: int, needs: dict[Path, list[Path]]) -> None:
        asked.append(
            ([name.name for name in commands], {k.name: [n.name for n in v] for k, v in needs.items()})
        )

    monkeypatch.setattr(script, "run_all", note)
    run("--pairs", *PAIRS, "00186", "--recipe=pads", "--encoder=own", "--no_scratch", "--jobs=9")
    ((names, needs),) = asked
    assert names[:3] == [f"encoder_{pair}" for pair in (*PAIRS, "00186")]  # the longest first
    assert names[3:6] == [f"demos_{pair}_0_30" for pair in (*PAIRS, "00186")]
    assert set(names[6:]) == set(needs)
    assert needs["00581_visual_0_30_pads"] == ["encoder_00581", "demos_00581_0_30"]


def test_dppo_may_start_in_hand_where_hands_can_hold_and_is_judged_from_the_table() -> None:
    options = parse(
        [
            "--mesh_dir=meshes",
            "--tune_start=grasped",
            "--recipe=pads",
            '--policy={"freeze_encoder": false}',
            "--encoder=outputs/{pair}",
            "--pairs",
            *PAIRS,
        ]
    )
    for policy in script.chosen(options):
        lines = {stage.name.split("_")[0]: stage.line for stage in script.stages(options, policy)}
        assert ("--env.start=grasped" in lines.pop("finetune")) == (policy.pair == "00007")
        assert not any("--env.start" in line for line in lines.values())
        assert f"--policy.pretrained_encoder=outputs/{policy.pair}" in lines["imitation"]
        assert f"--config_path=vtrefine:{script.TASKS[policy.pair]}" in lines["eval"]


@pytest.mark.usefixtures("fake_commands")
def test_dppo_may_start_from_a_bank_of_the_imitations_own_grasps(
    run: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trained, "MODALITIES", ("visuo_tactile",))
    told = run("--pairs", "00581", "--tune_start=bank", "--starts=64")
    assert told.count("Grasps of") == 1  # random weights never get that far
    bank = tmp_path / "out" / "starts_00581_visuo_tactile_0_30" / "starts.npz"
    assert bank.is_file()
    start = ["--tune_start=bank", "--starts=64", "--tune_steps=120"]
    options = parse([*common(tmp_path), "--pairs=00581", *start])
    for policy in script.chosen(options):
        stages = script.stages(options, policy)
        lines = [stage.line for stage in stages]
        practised = [line for line in lines if "--env.start_bank" in line]
        shorter = [line.split()[0] for line in lines if "--env.episode_steps=120" in line]
        if not policy.demonstrations:
            assert not practised + shorter
            continue
        assert [line.split()[0] for line in practised] == ["vtrefine-finetune"]
        assert shorter == ["vtrefine-record-starts", "vtrefine-finetune"]  # no grasp that comes too late
        assert f"--env.start_bank={bank}" in practised[0]
        (recorded,) = (line for line in lines if "record-starts" in line)
        assert "imitation_00581_visuo_tactile_0_30/checkpoints/last" in recorded
        assert "--num_starts=64" in recorded
        assert f"starts_{policy.name}" in next(s for s in stages if "finetune" in s.name).needs


def test_dppo_may_practise_in_longer_physics_steps_than_those_it_is_judged_in(tmp_path: Path) -> None:
    start = ["--tune_start=bank", "--tune_timestep_s=0.005", "--no_scratch"]
    options = parse([*common(tmp_path), "--pairs=00186", *start])
    for policy in script.chosen(options):
        lines = [stage.line for stage in script.stages(options, policy)]
        longer = [line.split()[0] for line in lines if "--env.scene.timestep_s=0.005" in line]
        assert longer == ["vtrefine-record-starts", "vtrefine-finetune"]


def test_an_encoder_of_ones_own_is_trained_from_the_table_and_policies_learn_on_its_features() -> None:
    options = parse(
        ["--mesh_dir=meshes", "--pairs=00446", "--recipe=pads", "--output_dir=out", "--encoder=own"]
    )
    for policy in script.chosen(options):
        encoder, record, imitation, *_ = script.stages(options, policy)
        assert "--config_path=vtrefine:automate_00446" in encoder.line
        assert "--env.start" not in encoder.line
        assert imitation.needs == (record.name, encoder.name)
        assert imitation.command[1].endswith("clone_on_features.py")
        assert '"pretrained_encoder": "out/encoder_00446"' in imitation.line
        assert f'"modalities": "{policy.senses}"' in imitation.line


def test_a_pairs_encoder_that_comes_with_the_package_is_taken_and_on_a_gpu_the_tables_recipe() -> None:
    options = parse(["--mesh_dir=meshes", "--pairs=00186", "--recipe=pads", "--backend=warp"])
    for policy in script.chosen(options):
        record, imitation, *_, finetune, _ = script.stages(options, policy)
        assert imitation.needs == (record.name,)
        assert '"pretrained_encoder": "vtrefine:automate_00186"' in imitation.line
        assert '"feature_noise": 0.3' in imitation.line
        assert "--dppo.type=trust_region --dppo.sampler=ddim" in finetune.line.replace(
            "--dppo.encoder=frozen ", ""
        )
    own = parse(["--mesh_dir=meshes", "--pairs=00186", "--recipe=pads", "--encoder=own"])
    encoder, *_ = script.stages(own, script.chosen(own)[0])
    assert encoder.name == "encoder_00186"


def test_the_papers_own_network_has_no_encoder_to_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["compare_paper.py", "--mesh_dir=meshes", "--encoder=own"])
    assert script.main() != 0
    told = capsys.readouterr().err
    assert told.startswith("error: --encoder")
    assert "--recipe=pads" in told


def test_an_encoder_that_is_named_is_taken_in_place_of_one_trained_here() -> None:
    for given in ("--encoder=mine", '--policy={"pretrained_encoder": "mine"}'):
        options = parse(["--mesh_dir=meshes", "--pairs=00446", "--recipe=pads", given])
        for policy in script.chosen(options):
            record, imitation, *_ = script.stages(options, policy)
            assert imitation.needs == (record.name,)
            assert '"pretrained_encoder": "mine"' in imitation.line


def test_episodes_that_the_simulation_ended_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    tell_of_room("finetune of 00081_visual_0_30", 0.004)
    assert not capsys.readouterr().err
    tell_of_room("finetune of 00081_visual_0_30", 0.28)
    told = capsys.readouterr().err
    assert told.startswith("warning: finetune of 00081_visual_0_30: 28% of the episodes ended because")
    assert told.count("\n") == 1


def test_so_are_those_of_practice_by_the_worst_iteration() -> None:
    assert most_without_room([{"success": 0.1}, {"failed_overflow": 0.14}, {"failed_overflow": 0.02}]) == 0.14
    assert most_without_room([]) == 0.0


def test_the_room_that_is_advised_is_more_than_any_pair_has() -> None:
    pairs = list((Path(__file__).parents[2] / "configs" / "env").glob("automate_*.yaml"))
    assert len(pairs) >= 5
    for pair in pairs:
        for name, number in yaml.safe_load(pair.read_text())["env"]["warp"].items():
            assert MORE_ROOM[name] > number, pair.name
