"""Whether errors belong to sliding, or to the recordings that happen to slide."""

from types import SimpleNamespace

import numpy as np

from lerobot_vtrefine.diagnose.pad.descriptors import DESCRIPTORS
from lerobot_vtrefine.diagnose.pad.rules import SLIDING
from lerobot_vtrefine.diagnose.pad.sliding_errors import while_sliding


def alarm_of(sliding: list[float], standing: list[float], share: list[float]):
    """The alarm for recordings of 400 frames with those errors (standard deviations) and parts that slide."""
    rng = np.random.default_rng(5)
    presses, residuals, weights = [], [], []
    for moved, still, part in zip(sliding, standing, share, strict=True):
        moves = np.arange(400) < part * 400
        x_m = np.cumsum(moves * 1e-4)
        trial = SimpleNamespace(time_s=np.arange(400) * 0.05, x_m=x_m, y_m=np.zeros(400))
        presses.append(SimpleNamespace(trial=trial, touching=np.ones(400, dtype=bool)))
        residuals.append(rng.standard_normal((400, 3)) * np.where(moves, moved, still)[:, None])
        weights.append(SimpleNamespace(sigma=1.0, memory=SimpleNamespace(white=lambda error: error)))
    model = SimpleNamespace(setting=SimpleNamespace(top_counts=100.0))
    fitted = SimpleNamespace(signals=[np.full((400, 3), 50.0)] * len(presses), model=model)
    return while_sliding(SimpleNamespace(presses=presses), residuals, fitted, weights)


def test_errors_that_every_slide_shows_are_told() -> None:
    found = alarm_of([1.5] * 4 + [1.0] * 4, [1.0] * 8, [0.4] * 4 + [0.0] * 4)
    assert found.share > found.least == 1 - 1 / SLIDING
    assert 1 - 1 / 2.0 < found.share < 1 - 1 / 2.5


def test_recordings_that_err_all_the_time_do_not_blame_their_slides() -> None:
    """They slide far, so that their errors weigh in what slides."""
    found = alarm_of([2.0] * 4 + [1.0] * 4, [2.0] * 4 + [1.0] * 4, [0.7] * 4 + [0.0] * 4)
    assert found.share == 0.0
    assert float(found.clue.split(" are ")[1].split()[0]) ** 2 > SLIDING  # though errors are larger there


def test_rest_has_no_direction() -> None:
    # Positions and rates at rest differ by rounding, whose sign filled whole recordings with directions.
    rng, frames = np.random.default_rng(6), np.arange(200)
    dust = 1e-12 * rng.standard_normal((3, 200))
    slides, sinks = frames >= 150, frames < 50
    trial = SimpleNamespace(
        time_s=frames * 0.05, x_m=dust[0] + np.cumsum(slides * 1e-4), y_m=dust[1], temperature_c=None
    )
    press = SimpleNamespace(
        trial=trial, drive=np.full((200, 1), 1e-3), rate=(dust[2] + sinks * 2e-3)[:, None], scored=[0]
    )
    wanted = ("the direction of sliding along the row", "loading or unloading")
    signal = np.ones((200, 1))
    way, depth = (
        item.direction(press, signal)[:, 0] for text in wanted for item in DESCRIPTORS if item.text == text
    )
    assert set(way[slides][1:]) == {1.0}
    assert not way[:149].any()
    assert set(depth[sinks]) == {1.0}
    assert not depth[~sinks].any()
