"""Which names survive: counted against an engine whose answers are known."""

from pathlib import Path

import numpy as np
from fake_diagnosis import pad_diagnosis

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial
from lerobot_vtrefine.diagnose.report.words import title
from lerobot_vtrefine.diagnose.stability import half, stability


def recordings(count: int) -> RecordingSet:
    one = np.zeros((3, 1))
    trials = tuple(RobotTrial(str(k), f"c{k}", k, 0.0, np.arange(3.0), one, one, None) for k in range(count))
    return RecordingSet(Path(), "robot", 0, 0, 0.0, 0.0, ("a",), trials)


def test_names_are_counted_over_draws_and_halves() -> None:
    found = pad_diagnosis()
    gain_spread, hysteresis = found.verdict.causes
    seen: list[tuple[int, int]] = []

    def again(given: RecordingSet, seed: int) -> Diagnosis:
        seen.append((len(given.trials), seed))
        if len(given.trials) < 9:
            return pad_diagnosis(causes=(gain_spread,))
        if seed == 8:
            tie = (("latency", "scan_skew"),)
            return pad_diagnosis(status="ambiguous", ambiguous_with=tie, next_experiment={"text": "more"})
        return found

    survived = stability(recordings(9), found, 2, 7, again)
    assert seen == [(9, 8), (9, 9), (5, 7), (5, 7)]
    assert survived.draws == {gain_spread.name: 2, hysteresis.name: 2, "latency": 1, "scan_skew": 1}
    assert survived.halves == {gain_spread.name: 2}
    line = survived.line(title)
    assert f"{title(hysteresis.name)} 2 and 0" in line
    assert "latency (not in the verdict) 1 and 0" in line


def test_halves_differ_and_keep_their_order() -> None:
    whole = recordings(12)
    halves = [[trial.order for trial in half(whole, seed).trials] for seed in range(4)]
    assert all(len(item) == 6 and item == sorted(set(item)) for item in halves)
    assert len({tuple(item) for item in halves}) > 1
