"""Broken recordings through the public command and the quality control: said, never guessed around."""

import json

import pytest
from hidden.corrupt import EITHER, REFUSED, REPORTED, VICTIM
from hidden.session import Spec
from hidden.writer import write_set

SEED = 7101


def damaged(path, damage, **changes):
    write_set(path, Spec("4x4", (("latency", "constant", 1.0),), corruption=damage, **changes), SEED)
    return path


@pytest.mark.parametrize("damage", REPORTED)
def test_damage_is_listed_and_its_trial_named(tmp_path, damage):
    from lerobot_vtrefine.diagnose.quality import check_quality
    from lerobot_vtrefine.diagnose.recordings import read_recording_set

    kept, issues = check_quality(read_recording_set(damaged(tmp_path / "set", damage)))
    assert issues
    if damage == "saturated_channel":
        assert any("(2, 2)" in issue.problem for issue in issues)
        return
    assert {issue.trial for issue in issues} == {VICTIM}
    gone = VICTIM not in [trial.file for trial in kept.trials]
    assert gone == all(issue.action == "set aside" for issue in issues)


def test_effects_and_noise_are_not_mistaken_for_damage(tmp_path):
    from lerobot_vtrefine.diagnose.quality import check_quality
    from lerobot_vtrefine.diagnose.recordings import read_recording_set

    for i, (effect, noise) in enumerate(
        [
            ("dead_taxels", "normal"),
            ("sample_and_hold", "normal"),
            ("row_sharing", "tails"),
            ("pad_tilt", "sites"),
        ]
    ):
        form = {"dead_taxels": "line", "sample_and_hold": "from_start", "row_sharing": "circuit"}.get(
            effect, "plane"
        )
        write_set(tmp_path / str(i), Spec("4x4", ((effect, form, 2.0),), noise=noise), SEED)
        kept, issues = check_quality(read_recording_set(tmp_path / str(i)))
        assert len(kept.trials) == 24, (effect, issues)
        assert all(issue.action == "kept" or issue.action.startswith("kept") for issue in issues), issues


@pytest.mark.parametrize("damage", [*REFUSED, *EITHER])
def test_unreadable_sets_end_the_command_with_one_line(tmp_path, damage, capsys):
    from lerobot_vtrefine.cli.diagnose import main

    folder = damaged(tmp_path / "set", damage)
    status = main([f"--recording={folder}", f"--output_dir={tmp_path / 'out'}"])
    said = capsys.readouterr().err.strip().splitlines()
    assert status == 2
    assert len(said) == 1
    assert ("recording.json" if damage in ("broken_json", "wrong_schema") else VICTIM) in said[0]
    column = {"missing_column": "x_m", "short_rows": "raw", "ragged_rows": "raw"}.get(damage, "")
    assert column in said[0]
    assert not (tmp_path / "out" / "verdict.json").exists()


def test_a_damaged_trial_does_not_change_the_verdict(tmp_path, capsys):
    from lerobot_vtrefine.cli.diagnose import main
    from lerobot_vtrefine.cli.predict import main as predict

    folder = damaged(tmp_path / "set", "mirrored_rows", changes=(("conditions", 10),))
    assert main([f"--recording={folder}", f"--output_dir={tmp_path / 'out'}"]) == 0
    capsys.readouterr()
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text(encoding="utf-8"))
    assert verdict["schema"] == "vtrefine/verdict@1"
    assert verdict["status"] == "explained"
    assert [cause["name"] for cause in verdict["causes"]] == ["latency"]
    assert [issue["trial"] for issue in verdict["data_issues"]] == [VICTIM]
    assert VICTIM not in verdict["heldout"]["trials"]
    model = tmp_path / "out" / "sensor_model.json"
    assert (
        predict([f"--recording={folder}", f"--sensor_model={model}", f"--output_dir={tmp_path / 'p'}"]) == 0
    )
    assert (tmp_path / "p" / "trial_0000.parquet").exists()
