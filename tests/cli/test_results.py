"""Results are files: rows are checked, runs become rows, documents hold the tables that the rows give."""

import csv
import json
import re
import sys
from dataclasses import asdict, replace
from pathlib import Path
from statistics import mean

import collect_results
import make_tables
import numpy as np
import pytest

from lerobot_vtrefine.cli import demo
from lerobot_vtrefine.cli.report.statistics import mean_interval, wilson_interval
from lerobot_vtrefine.cli.results import provenance
from lerobot_vtrefine.cli.results.cells import difference, over_seeds, pooled
from lerobot_vtrefine.cli.results.collect import largest_fall, run_rows, steps_to
from lerobot_vtrefine.cli.results.paper_tables import FURTHER, JUDGED_ANEW, practised
from lerobot_vtrefine.cli.results.published import PAIRS, with_demonstrations
from lerobot_vtrefine.cli.results.rows import (
    IMITATION,
    SCRATCH,
    TUNED,
    Line,
    Row,
    Run,
    merge,
    read_all,
    read_rows,
    write_rows,
)
from lerobot_vtrefine.cli.results.store import save
from lerobot_vtrefine.cli.results.tables import BLOCK, DERIVED, fill, table
from lerobot_vtrefine.finetune.logger import ProgressLog
from lerobot_vtrefine.finetune.pipeline import CONFIG_NAME

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
ORIGIN = {"commit": "0123abc", "command": "vtrefine-demo", "machine": "2 cores"}


def run_of(success: float, seed: int | None = 0, **changes) -> Run:
    row = Run(
        table="touch",
        task="tight",
        policy="visual",
        seed=seed,
        success=success,
        episodes=200,
        iterations=30,
        env_steps=123_456,
        **ORIGIN,
    )
    return replace(row, **changes)


def test_documents_hold_the_tables_of_the_files() -> None:
    """After a change of results/*.json: make tables."""
    rows = read_all(RESULTS)
    shown = set()
    for path in make_tables.documents():
        text = path.read_text(encoding="utf-8")
        assert fill(text, rows) == text, f"{path.name} differs from results/*.json; run make tables"
        shown |= {block[1] for block in BLOCK.findall(text)}
        outside = re.sub(r"```.*?```", "", BLOCK.sub("", text), flags=re.DOTALL)
        assert [line for line in outside.splitlines() if line.startswith("|")] == [], path.name
    assert shown == {row.table for row in rows} | {name for name, of in DERIVED.items() if of(rows)}


def test_curves_are_small_and_belong_to_rows() -> None:
    named = {RESULTS / row.curve for row in read_all(RESULTS) if isinstance(row, Run) and row.curve}
    assert set(RESULTS.glob("curves/*")) == named
    assert sum(path.stat().st_size for path in RESULTS.rglob("*") if path.is_file()) < 2_000_000


def test_the_gain_by_dppo_that_pages_quote_is_that_of_the_rows() -> None:
    """Imitations are means over seeds there, so no more than the average can be quoted from them."""
    rows = [row for row in read_rows(RESULTS / "touch.json") if isinstance(row, Run)]
    before = {(row.task, row.policy): row.success for row in rows if row.variant == IMITATION}
    tuned = [row for row in rows if row.variant == TUNED and row.seed is not None]
    gain = sum(row.success - before[row.task, row.policy] for row in tuned) / len(tuned)
    told = f"by {100 * gain:.0f} points on average"
    assert f"DPPO lifts {len(tuned)} policies {told}" in words_of("README.md")
    assert f"DPPO lifts them {told}" in words_of("docs/results.md")


def words_of(page: str) -> str:
    return " ".join((ROOT / page).read_text(encoding="utf-8").split())


def test_a_changed_figure_changes_the_document(tmp_path: Path) -> None:
    rows = [run_of(0.5, seed, policy=name) for seed in (0, 1) for name in ("visuo_tactile", "visual")]
    text = fill("# Title\n<!-- table: touch -->\nold\n<!-- end -->\nafter\n", rows)
    assert "| tight: 1 mm clearance | - / - | 50 (50, 50) | 50 (50, 50) | +0 [0, 0] |" in text
    assert text.startswith("# Title\n")
    assert text.endswith("<sub>Commit: 0123abc; machine: 2 cores.</sub>\n<!-- end -->\nafter\n")
    assert fill(text, rows) == text
    assert "52 (55, 50)" in fill(text, [replace(rows[0], success=0.55), *rows[1:]])
    with pytest.raises(ValueError, match="table demo: results/ hold no rows of it"):
        fill("<!-- table: demo -->\n<!-- end -->", rows)


def test_decimals_have_a_zero_before_the_point() -> None:
    row = Line(
        table="diagnosis",
        cells={"": "gain .1 to .2", "engine": ".98 [.95, 1.0]", "bar": "v1.2 3.5"},
        **ORIGIN,
    )
    assert "| gain 0.1 to 0.2 | 0.98 [0.95, 1.0] | v1.2 3.5 |" in table("diagnosis", [row])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"success": 68}, "success must lie in 0..1, got 68"),
        ({"success": None}, "success must be a number, got None"),
        ({"seed": "3"}, "seed must be a whole number or null, got '3'"),
        ({"seed": True}, "seed must be a whole number or null, got True"),
        ({"seed": -1}, "seed must not be negative, got -1"),
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
        ({"table": "tuoch"}, "table=tuoch is unknown; choose from converges, demo, touch"),
        ({"commit": "yesterday"}, "commit must be a hash, got 'yesterday'"),
        ({"extra": {"seconds": [1]}}, "extra must map names to a number or text"),
        ({"sucess": 0.5}, "has unknown sucess"),
        ({"curve": "curves/none.csv"}, "curve curves/none.csv is not a file"),
        ({"cells": {"a": "b"}}, "has unknown"),
    ],
)
def test_a_wrong_row_is_told_by_file_row_and_field(change: dict, message: str, tmp_path: Path) -> None:
    path = tmp_path / "touch.json"
    good = asdict(run_of(0.5))
    path.write_text(json.dumps({"rows": [good, good | {"seed": 1} | change]}))
    with pytest.raises(ValueError, match=r"touch.json: row 2: " + re.escape(message)) as error:
        read_rows(path)
    assert "\n" not in str(error.value)


def test_what_is_no_file_of_rows_is_told(tmp_path: Path) -> None:
    path, good = tmp_path / "touch.json", asdict(run_of(0.5))
    for text, message in (
        ("{", "touch.json: no JSON"),
        ("[]", r"touch.json: must be \{\"rows\""),
        (json.dumps({"rows": [good, good]}), "row 2: stands for the same as an earlier one"),
        (json.dumps({"rows": [{k: v for k, v in good.items() if k != "machine"}]}), "row 1: lacks machine"),
        (
            json.dumps({"rows": [good | {"curve": "touch.json"}, good | {"seed": 1, "curve": "touch.json"}]}),
            "row 2: curve touch.json is an earlier row's",
        ),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_rows(path)
    for name in ("a.json", "b.json"):
        write_rows(tmp_path / "two" / name, [run_of(0.5)])
    with pytest.raises(ValueError, match=r"b\.json: table touch is in another file too"):
        read_all(tmp_path / "two")


def test_rows_survive_the_file_and_replace_their_like(tmp_path: Path) -> None:
    pool = run_of(0.4, None, commit=None, command=None, machine=None, env_steps=None)
    rows: list[Row] = [pool, run_of(0.5, 7), Line(table="worlds", cells={"worlds": "64", "": ""}, **ORIGIN)]
    write_rows(tmp_path / "rows.json", rows)
    assert read_rows(tmp_path / "rows.json") == rows
    assert '"commit": null' in (tmp_path / "rows.json").read_text()
    assert merge(rows, rows) == rows
    assert merge(rows, [run_of(0.6, 7)]) == [run_of(0.6, 7), rows[2]]  # a seed's own takes the pool's place
    other = run_of(0.6, 7, variant="imitation")
    assert merge(rows, [other]) == [*rows, other]


@pytest.mark.parametrize(("successes", "trials"), [(71, 200), (0, 10), (10, 10), (1, 1024), (1000, 1024)])
def test_wilson_bounds_lie_where_the_rate_is_196_deviations_away(successes: int, trials: int) -> None:
    for bound in wilson_interval(successes, trials):
        deviation = 1.959964 * np.sqrt(bound * (1 - bound) / trials)
        assert abs(successes / trials - bound) == pytest.approx(deviation, abs=1e-6)


def test_interval_over_seeds_has_students_quantile() -> None:
    assert mean_interval([1.0, 2.0, 3.0]) == pytest.approx(
        (2.0, 2 - 4.302653 / 3**0.5, 2 + 4.302653 / 3**0.5)
    )
    values = np.random.default_rng(0).normal(size=(20_000, 6))
    half = 2.570582 * values.std(axis=1, ddof=1) / 6**0.5  # 5 degrees of freedom
    assert np.mean(np.abs(values.mean(axis=1)) < half) == pytest.approx(0.95, abs=0.01)
    assert mean_interval(list(values[0]))[2] == pytest.approx(values[0].mean() + half[0])
    assert mean_interval([0.5]) == (0.5, -np.inf, np.inf)


def test_figures_of_a_cell() -> None:
    assert pooled([run_of(0.685)], unit=" %") == "68 % [62, 75]"
    assert pooled([run_of(0.6, 0), run_of(0.8, 1)]) == "70 [65, 74] (60, 80)"
    assert (
        pooled([run_of(0.71, None, episodes=400), run_of(0.6, 0), run_of(0.8, 1)], bounds=False)
        == "71 (60, 80)"
    )
    assert pooled([]) == "-"
    assert over_seeds([run_of(0.9, 0), run_of(1.0, 1)]) == "95 [31, 100] (90, 100)"  # no success above all
    one, two = (
        [run_of(rate, seed) for seed, rate in rates] for rates in (((0, 0.5), (1, 0.6)), ((1, 0.7), (2, 0.9)))
    )
    assert difference(one, two) == "+10"  # the one seed that both have
    assert difference(one, [run_of(0.6, 0), run_of(0.6, 1)]) == "+5 [-59, 69]"


def test_converging_runs_show_mean_worst_seed_and_cost() -> None:
    rows = [
        run_of(rate, seed, table="converges", task="square_1mm", iterations=150, extra={"largest_fall": fall})
        for seed, rate, fall in ((0, 0.96, 0.02), (1, 0.94, 0.075))
    ]
    expected = "| square_1mm | vision only | after DPPO | 95 [82, 100] (96, 94) | 94 | 150 | 123 456 | 8 |"
    assert expected in table("converges", rows)
    assert "| 150 | - | 8 |" in table("converges", [replace(row, env_steps=None) for row in rows])


def test_handling_stands_beside_success_and_touch_is_compared_seed_by_seed() -> None:
    rows = [
        run_of(0.9, seed, table="converges", task="cross", policy=policy, extra={"mean_peak_force_n": force})
        for policy, forces in (("visual", (4.0, 5.0)), ("visuo_tactile", (3.0, 4.4)))
        for seed, force in enumerate(forces)
    ]
    text = table("handling", [*rows, run_of(0.5, 9, table="converges", task="never measured")])
    assert "| cross | after DPPO | vision only | - | - | 4.5 [-1.9, 10.9] | - | - |" in text
    assert "| cross | after DPPO | touch minus vision | - | - | -0.8 [-3.3, 1.7] | - | - |" in text
    assert "never measured" not in text


def test_what_touch_gives_is_told_before_and_after_dppo() -> None:
    """A task without DPPO yet has dashes there; one with a single kind of policy is left out."""
    rows = [
        run_of(rate, seed, table="converges", task="cross", policy=policy, variant="imitation")
        for policy, rates in (("visuo_tactile", (0.8, 0.9)), ("visual", (0.4, 0.5)))
        for seed, rate in enumerate(rates)
    ]
    line = "| cross | 85 [21, 100] (80, 90) | 45 [0, 100] (40, 50) | +40 [40, 40] |"
    assert f"{line} - | - | - |" in table("senses", rows)
    tuned = [replace(row, variant="", success=min(row.success + 0.1, 1.0)) for row in rows]
    assert f"{line} 95 [31, 100] (90, 100) | 55 [0, 100] (50, 60) | +40 [40, 40] |" in table(
        "senses", [*rows, *tuned]
    )
    assert "cross" not in table("senses", rows[:2])


def test_samples_stand_beside_the_references() -> None:
    curve = [
        {"iteration": 0.0, "env_steps": 0.0, "eval_success": 0.4},
        {"iteration": 1.0, "env_steps": 5_000.0},
        {"iteration": 2.0, "env_steps": 10_000.0, "eval_success": 0.8},
        {"iteration": 3.0, "env_steps": 20_000.0, "eval_success": 0.7},
    ]
    assert steps_to(curve) == {"steps_to_0.5": 10_000.0, "steps_to_0.75": 10_000.0}
    rows = [run_of(0.7, None, table="reference", variant="reference DPPO", extra=steps_to(curve))]
    end = "| reference DPPO | 70 [63, 76] | 123 456 | 10 000 | 10 000 | - |"
    assert end in table("reference", rows)


def test_a_runs_own_evaluations_bring_what_they_measured(tmp_path: Path) -> None:
    """Before its first iteration, and after its last."""
    log = ProgressLog(tmp_path, 0, None)
    for iteration, success, force in ((0, 0.4, 1.23456), (2, 0.9, 2.0)):
        measured = {"eval_success": success, "eval_episodes": 10.0, "eval_peak_force_n": force}
        log.add(iteration, {**measured, "env_steps": 100.0})
    settings = {"dppo": {"iterations": 2}, "seed": 3}
    (tmp_path / CONFIG_NAME).write_text(json.dumps(settings))
    named = {"table": "converges", "task": "cross", "policy": "visual"}
    before, after = (row for row, _ in run_rows(tmp_path, named, ORIGIN))
    assert before.extra == {"mean_peak_force_n": 1.235}
    assert after.extra["mean_peak_force_n"] == 2.0
    assert "| cross | imitation | vision only | - | - | 1.2 | - | - |" in table("handling", [before, after])


def test_the_papers_numbers_are_the_papers() -> None:
    """Its text: fine-tuning with touch reaches .856 over the five pairs, with vision .602."""
    for name, expected in (("visuo_tactile", 0.856), ("visual", 0.602)):
        assert mean(pair[name][TUNED] for pair in PAIRS.values()) == pytest.approx(expected)


def test_pairs_stand_beside_the_papers_and_their_mean_counts_seeds_that_all_have() -> None:
    rows = [
        run_of(rate, seed, table="paper", task=f"automate/{pair}", policy=policy, episodes=100)
        for pair, policy, rates in (
            ("00186", "visual", (0.5, 0.7)),
            ("00186", "visuo_tactile", (0.9, 0.8)),
            ("00446", "visual", (0.6, 0.6)),
            ("00446", "visuo_tactile", (0.8, 0.9, 1.0)),
            ("00007", "visuo_tactile", (1.0,)),
        )
        for seed, rate in enumerate(rates)
    ]
    lines = table("paper", rows).splitlines()
    assert lines[2] == (
        "| DPPO after imitation | automate/00186 | 60 [0, 100] (50, 70) | 72 | 85 [21, 100] (90, 80) | 94"
        " | +25 [-166, 216] | +22 |"
    )
    assert lines[3].startswith("| DPPO after imitation | automate/00007 | - | 84 | 100 [96, 100] | 98 | - |")
    assert lines[5] == (
        "| DPPO after imitation | mean of 2 | 60 [0, 100] (55, 65) | 54 | 85 [85, 85] (85, 85) | 85"
        " | +25 [-39, 89] | +31 |"
    )


def test_pairs_that_share_no_seed_have_no_mean() -> None:
    rows = [
        run_of(0.5, seed, table="paper", task=f"automate/{pair}", policy=policy, episodes=100)
        for seed, pair in enumerate(("00186", "00007"))
        for policy in ("visual", "visuo_tactile")
    ]
    assert "mean of" not in table("paper", rows)


def test_after_further_practice_stands_who_practised_longest_as_judged_last() -> None:
    named = {"task": "automate/00446", "policy": "visuo_tactile", "episodes": 100}
    tried = named | {"table": "tried"}
    *_, first, last, gone_on = FURTHER
    rows = [
        run_of(0.9, 0, **tried, variant=gone_on, iterations=70),
        run_of(0.5, 0, **named, table="paper", iterations=14),
        run_of(0.6, 0, **tried, variant=last, iterations=42),
        run_of(0.4, 1, **named, table="paper", iterations=14),
        run_of(0.8, 1, **tried, variant=JUDGED_ANEW, iterations=14),
        run_of(0.3, 2, **named, table="paper", iterations=14),
        run_of(0.1, 2, **tried, variant=f"{last}, half the noise", iterations=42),
        run_of(0.7, 2, **tried, variant=first, iterations=42),
    ]
    assert "| 80 [55, 100] (90, 80, 70) | 76 |" in table("paper_practised", rows)
    assert [run.iterations for run in practised(rows)] == [14, 14, 14, 70, 42, 42]


def test_fewer_demonstrations_stand_beside_the_papers() -> None:
    named = {"policy": "visuo_tactile", "episodes": 100}
    few = run_of(
        0.8, 0, table="demonstrations", task="automate/00186", variant=with_demonstrations(10, TUNED), **named
    )
    whole = [
        run_of(rate, 0, table="paper", task=task, variant=kind, **named)
        for task, kind, rate in (
            ("automate/00186", IMITATION, 0.5),
            ("automate/00186", SCRATCH, 0.0),  # of no number
            ("automate/00007", IMITATION, 0.9),  # of another pair
        )
    ]
    lines = table("demonstrations", [few, *whole]).splitlines()
    assert lines[2] == "| DPPO after imitation | 10 | - | 21 | 80 [71, 87] | 34 | - | +13 |"
    assert lines[3] == "| imitation | 30 | - | 40 | 50 [40, 60] | 48 | - | +8 |"
    assert not lines[4]


def test_the_experts_table_lays_bodies_and_starts_beside_each_other() -> None:
    rows = [
        run_of(19 / 20, None, table="expert", task="round, 2 mm", policy=body, variant=start, episodes=20)
        for body, start in (("aloha", "table"), ("kinova", "grasped"))
    ]
    text = table("expert", rows)
    assert "ALOHA, from the table | ALOHA, in hand | two Kinova Gen3, from the table" in text
    assert "| round, 2 mm | 19 of 20 [76, 99] | - | - | 19 of 20 [76, 99] |" in text


def test_a_fall_counts_in_the_last_half_alone() -> None:
    success = [0.0, 0.5, 0.1, 0.7, 0.55, 0.8]
    rows = [{"iteration": float(index), "success": value} for index, value in enumerate(success)]
    assert largest_fall(rows) == 0.15
    assert largest_fall(rows[:3]) == 0.4


@pytest.fixture
def collect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Run the script on a results file of the test's own -> exit status, rows."""
    path = tmp_path / "results" / "rows.json"

    def run(*arguments: str) -> tuple[int, list[Row]]:
        monkeypatch.setattr(sys, "argv", ["collect_results.py", *arguments, f"--results={path}"])
        return collect_results.main(), read_rows(path) if path.is_file() else []

    return run


@pytest.mark.usefixtures("fake_commands")
def test_a_demo_becomes_rows(collect, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "tight" / "visuo_tactile_3"
    flags = ["--quick", "--videos=0", "--ablation_episodes=8", "--seed=3", f"--output_dir={folder}"]
    demo.run_demo(demo.parse_config(flags))
    status, rows = collect("demo", str(folder))
    assert (status, len(rows)) == (0, 6)
    before, after = (next(row for row in rows if row.variant == name) for name in ("imitation", ""))
    assert (before.task, before.policy, before.seed) == ("tight", "visuo_tactile", 3)
    assert (before.success, before.episodes, before.iterations, before.env_steps) == (0.25, 8, 0, 0)
    assert (after.success, after.iterations) == (0.75, 2)
    assert after.extra == {
        "in_hand_shift_m": 0.001,
        "rim_slide_m": 0.01,
        "peak_force_n": 8.0,
        "time_to_success_s": 2.0,
    }
    assert after.commit == provenance.commit()
    assert after.machine.endswith("cores")
    text = table("demo", rows)
    assert "| seed 3 | imitation | after DPPO |" in text
    assert "| success with vision replaced by its mean (8 episodes) | 25 % [7, 59] | 75 % [41, 93] |" in text

    curve = tmp_path / "results" / after.curve
    assert before.curve is None
    with curve.open() as file:
        assert [float(row["success"]) for row in csv.DictReader(file)] == pytest.approx(np.arange(5) / 10)

    assert collect("demo", str(folder)) == (0, rows)  # the same again
    assert (
        collect("demo", str(folder), "--variant=10 demonstrations")[1][6].variant
        == "10 demonstrations, imitation"
    )

    others = [replace(row, seed=8, curve=None) for row in rows]
    write_rows(tmp_path / "results" / "rows.json", [*others, *(replace(row, task="else") for row in others)])
    other = curve.with_name("demo-of_nothing.csv")
    other.touch()
    assert len(collect("demo", str(folder))[1]) == 18
    replaced = collect("demo", str(folder), "--replace")[1]
    assert {(row.task, row.seed) for row in replaced} == {("tight", 3), ("else", 8)}
    assert {curve, other} <= set(curve.parent.iterdir())
    assert "6 rows in" in capsys.readouterr().out


def test_a_results_file_removes_curves_of_its_own_alone(tmp_path: Path) -> None:
    progress = [{"iteration": 1.0, "env_steps": 8.0, "success": 0.5}]
    one, two = tmp_path / "reference.json", tmp_path / "trial.json"
    for path in (one, two):
        save(path, [(run_of(0.5, seed, table="reference"), progress) for seed in (0, 1)], replace=False)
    curves = {path: {row.curve for row in read_rows(path)} for path in (one, two)}
    assert len(curves[one] | curves[two]) == 4
    copied = [*read_rows(two), *(replace(row, task="copied") for row in read_rows(one))]
    write_rows(two, copied)
    again = [(run_of(0.6, 2, table="reference", task=task), progress) for task in ("tight", "copied")]
    save(two, again, replace=True)
    left = {f"curves/{path.name}" for path in (tmp_path / "curves").iterdir()}
    assert left == curves[one] | {row.curve for row in read_rows(two)}
    assert len(left) == 4


def test_printed_tables_become_rows(collect, tmp_path: Path) -> None:
    printed = tmp_path / "worlds.md"
    printed.write_text(
        "measuring ...\n| worlds | rate | |\n|---|---|---|\n| 1 | 63 | |\n| 64 | 3 160 | .3 |\n"
    )
    status, rows = collect("worlds", str(printed), "--commit=0123abc", "--machine=1 x NVIDIA H200")
    assert status == 0
    assert [row.cells for row in rows] == [
        {"worlds": "1", "rate": "63", "": ""},
        {"worlds": "64", "rate": "3 160", "": ".3"},
    ]
    assert table("worlds", rows).splitlines()[:3] == ["| worlds | rate | |", "|---|---|---|", "| 1 | 63 | |"]


def test_what_cannot_be_collected_is_one_line_and_changes_nothing(
    collect, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rows(tmp_path / "results" / "rows.json", [run_of(0.5)])
    status, rows = collect("touch", str(tmp_path), "--replace")
    assert (status, rows) == (2, [run_of(0.5)])
    assert capsys.readouterr().err.startswith(f"error: {tmp_path} holds neither results.json")


def test_commands_name_no_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["/" + "opt/bin/vtrefine-finetune", "--output_dir=/" + "home/me/a/run", "--env.type=vtrefine"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--policy.path=outputs/pretrain", "--env={pair: key}"])
    line = provenance.command()
    assert line == (
        "vtrefine-finetune --output_dir=.../run --env.type=vtrefine --policy.path=outputs/pretrain"
        " '--env={pair: key}'"
    )
