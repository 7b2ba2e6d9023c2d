"""When readings were new, and the rhythm in which they are held."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_engine_forward import composite, presses, trial

from lerobot_vtrefine.diagnose.pad.baseline import describe
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import (
    FORMS,
    could_be_held,
    groups_apart,
    held,
    irregular_periods,
    periods_apart,
    repeated_share,
)
from lerobot_vtrefine.diagnose.pad.fitting import predict
from lerobot_vtrefine.diagnose.pad.noise import fit_frame_noise
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet, prepare
from lerobot_vtrefine.diagnose.pad.repeated_frames import Rhythm, ages_s, slots
from lerobot_vtrefine.diagnose.pad.thinning import held_every
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.base import Frame
from lerobot_vtrefine.tactile.stages.host import SampleAndHold, taken_at_frames
from lerobot_vtrefine.tactile.stages.signals import sampled


def held_recording(period_s: float, phase: float, seed: int) -> Rhythm:
    """Noise of two taxels at 20 Hz for 10 s, held."""
    time_s = np.arange(200) * 0.05
    noise = np.random.default_rng(seed).standard_normal((200, 2))
    slot = slots(time_s, period_s, phase)
    first = np.searchsorted(slot, slot, side="left")
    return Rhythm.of(time_s, noise[first], np.ones(200, dtype=bool))


@pytest.mark.parametrize(("period_s", "phase"), [(0.13, 0.3), (0.185, 0.9), (0.21, 0.0)])
def test_the_phase_of_held_readings_is_found(period_s: float, phase: float) -> None:
    rhythm = held_recording(period_s, phase, 3)
    assert abs((rhythm.phase(period_s) - phase + 0.5) % 1.0 - 0.5) < 0.06
    due, changed, changes, repeats, late = rhythm.against(period_s, free=True)
    assert changed <= 0.03 * due
    assert late <= 0.03 * repeats
    assert changes == pytest.approx(10.0 / period_s, abs=2)


def test_another_period_is_contradicted() -> None:
    due, changed, *_ = held_recording(0.13, 0.3, 4).against(0.17, free=True)
    assert changed > 0.2 * due


def test_a_free_board_predicts_the_mean_over_its_instants() -> None:
    layout = PadLayout(1, 1, 0.002)
    time_s = torch.arange(400, dtype=torch.float64) * 0.01
    ramp = (3.0 * time_s)[:, None, None]
    stage = SampleAndHold(0.2, free=True)
    mean = stage.sequence(ramp, time_s, Frame(layout))[200:, 0, 0]
    assert torch.allclose(mean, ramp[200:, 0, 0] - 3.0 * 0.1)


def test_a_free_board_holds_from_an_instant_of_its_own_in_every_episode() -> None:
    layout = PadLayout(1, 1, 0.002)
    stage = SampleAndHold(0.2, free=True)
    traits = stage.traits(layout, 3, np.random.default_rng(0))
    assert len(set(traits["phase"].ravel().tolist())) == 3
    state = {key: torch.as_tensor(value) for key, value in {**stage.initial(layout, 3), **traits}.items()}
    changes = torch.zeros(3)
    previous = None
    for k in range(100):
        x = torch.full((3, 1, 1), float(k))
        held, state = stage.step(x, state, Frame(layout, dt_s=0.01, time_s=0.01 * k))
        changes += 0 if previous is None else (held != previous).reshape(3)
        previous = held
    assert ((changes >= 4) & (changes <= 5)).all()


@pytest.mark.parametrize("groups", [(), (0, 1)])
def test_models_of_free_boards_survive_their_file(groups: tuple[int, ...]) -> None:
    model = SensorModel.paper().with_stage(SampleAndHold(0.2, free=True, groups=groups))
    assert SensorModel.from_dict(model.to_dict()) == model


def test_a_free_board_read_at_the_frames_predicts_the_mean_over_its_instants() -> None:
    time_s = torch.arange(400, dtype=torch.float64) * 0.05
    ramp = (3.0 * time_s)[:, None, None]
    stage = SampleAndHold(0.2, free=True, frame_s=0.05)
    mean = stage.sequence(ramp, time_s, Frame(PadLayout(1, 1, 0.002)))[200:, 0, 0]
    # New in every fourth frame: readings are 0, 1, 2 or 3 frames old.
    assert torch.allclose(mean, ramp[200:, 0, 0] - 3.0 * 1.5 * 0.05)


def test_a_board_read_at_the_frames_holds_what_the_first_frame_of_a_period_showed() -> None:
    time_s = np.arange(40) * 0.05
    held = taken_at_frames(time_s, 0.12, 0.05)
    np.testing.assert_allclose(held[:8], [0, 0, 0, 0.15, 0.15, 0.25, 0.25, 0.25], atol=1e-9)
    late = torch.as_tensor(3.0 * time_s)[:, None, None]
    frames = SampleAndHold(0.12, frame_s=0.05).sequence(
        late, torch.as_tensor(time_s), Frame(PadLayout(1, 1, 0.002))
    )
    np.testing.assert_allclose(frames[:, 0, 0], 3.0 * held, atol=1e-9)


def test_irregular_readings_are_the_mean_over_the_ages_that_were_seen() -> None:
    time_s = torch.arange(100, dtype=torch.float64) * 0.05
    ages_s = (0.0, 0.0, 0.05, 0.15)
    stage = SampleAndHold(0.1, ages_s=ages_s, lag_s=0.01)
    mean = stage.sequence((time_s**2)[:, None, None], time_s, Frame(PadLayout(1, 1, 0.002)))
    at = [(time_s - age - 0.01).clamp(min=0.0) for age in ages_s]
    expected = torch.stack([sampled(time_s**2, time_s, when) for when in at]).mean(dim=0)
    assert torch.allclose(mean[:, 0, 0], expected)
    assert (
        SensorModel.from_dict(SensorModel.paper().with_stage(stage).to_dict()).find("sample_and_hold")
        == stage
    )
    with pytest.raises(ValueError, match="ages_s"):
        SampleAndHold(0.1, ages_s=(-0.1,))


def test_ages_of_frames_that_drop_out_are_those_of_their_law() -> None:
    # At random a frame is k frames old with chance 0.4 * 0.6^k: a few are very old, most are new.
    rng = np.random.default_rng(7)
    lost = [dropped(rng.standard_normal((2000, 2)), 0.6, rng) for _ in range(4)]
    found = ages_s([press.rhythm for press in press_set(lost).presses])
    parts = (np.arange(len(found)) + 0.5) / len(found)
    np.testing.assert_allclose(found, 0.05 * np.floor(np.log(1 - parts) / np.log(0.6)), atol=0.051)
    assert np.mean(found) == pytest.approx(0.05 * 0.6 / 0.4, rel=0.1)


def press_set(signals: list[np.ndarray]) -> SimpleNamespace:
    """Presses at 20 Hz, always in touch, with a drive that goes up and down."""
    presses = []
    for signal in signals:
        time_s = np.arange(len(signal)) * 0.05
        drive = np.abs(np.sin(2.0 * time_s))[:, None, None]
        image = signal.reshape(len(signal), -1, 10) if signal.shape[1] % 10 == 0 else None
        rhythm = Rhythm.of(time_s, signal, np.ones(len(signal), dtype=bool), image)
        taxels, layout = np.arange(signal.shape[1]), SimpleNamespace(full_cols=10)
        presses.append(
            SimpleNamespace(
                time_s=time_s,
                signal=signal,
                drive=drive,
                rhythm=rhythm,
                taxels=taxels,
                layout=layout,
                whole=None,
            )
        )
    return SimpleNamespace(presses=tuple(presses))


def dropped(signal: np.ndarray, chance: float, rng: np.random.Generator) -> np.ndarray:
    """Frames lost at random, the one before in their place."""
    there = rng.random(len(signal)) >= chance
    there[0] = True
    return signal[np.maximum.accumulate(np.where(there, np.arange(len(signal)), 0))]


@pytest.mark.parametrize(("taxels", "noise"), [(20, 0.6), (1, 1.0)])
def test_frames_that_repeat_at_random_are_held_and_chance_repeats_are_not(taxels: int, noise: float) -> None:
    rng = np.random.default_rng(5)
    motion = 80.0 * np.abs(np.sin(2.0 * np.arange(200) * 0.05))[:, None]
    whole = [np.round(motion + noise * rng.standard_normal((200, taxels))) for _ in range(6)]
    lost = [dropped(signal, 0.25, rng) for signal in whole]
    assert held(press_set(lost))
    assert not held(press_set(whole))
    period_s, _ = irregular_periods(press_set(lost), 0.05)[0]
    assert period_s == pytest.approx(0.05 / 0.75, rel=0.1)


def test_readings_that_never_repeat_are_not_held_however_late() -> None:
    rng = np.random.default_rng(5)
    motion = 80.0 * np.abs(np.sin(2.0 * np.arange(200) * 0.05 - 0.3))[:, None]
    late = [np.round(motion + rng.standard_normal((200, 20))) for _ in range(6)]
    assert not could_be_held(press_set(late))
    assert could_be_held(press_set([dropped(signal, 0.1, rng) for signal in late]))
    rows = [np.hstack([signal[:, :10], dropped(signal[:, 10:], 0.3, rng)]) for signal in late]
    assert could_be_held(press_set(rows))
    # Readings under an indenter that hardly moves say nothing.
    assert could_be_held(press_set([signal[:5] for signal in late]))


def test_a_stream_that_freezes_now_and_then_is_held() -> None:
    rng = np.random.default_rng(5)
    motion = 80.0 * np.abs(np.sin(2.0 * np.arange(200) * 0.05))[:, None]
    frozen = [np.round(motion + rng.standard_normal((200, 20))) for _ in range(6)]
    assert not held(press_set(frozen))
    for signal in frozen:
        signal[[60, 140]] = signal[[59, 139]]
    assert held(press_set(frozen))


def test_a_still_pad_of_one_taxel_that_repeats_is_not_held() -> None:
    rng = np.random.default_rng(6)
    still = [np.round(0.3 * rng.standard_normal((200, 1))) for _ in range(6)]
    assert not held(press_set(still))


def test_readings_without_noise_that_repeat_while_the_indenter_rests_are_not_held() -> None:
    presses = press_set([np.zeros((200, 8)) for _ in range(4)]).presses
    for press in presses:
        press.drive[:] = np.minimum(press.drive, 0.5)
        press.signal[:] = 100.0 * press.drive[:, :, 0] * np.arange(1, 9)
        press.rhythm = Rhythm.of(press.time_s, press.signal, np.ones(200, dtype=bool))
        assert (press.rhythm.telling & ~press.rhythm.fresh).sum() > 50
    assert not held(SimpleNamespace(presses=presses))


def test_held_frames_show_what_the_model_said_at_the_last_new_one() -> None:
    rhythm = press_set([np.array([[1.0], [1.0], [2.0], [2.0], [2.0], [3.0]])]).presses[0].rhythm
    np.testing.assert_allclose(rhythm.taken_s(rhythm.time_s), np.array([0, 0, 2, 2, 2, 5]) * 0.05)
    values = np.arange(12.0)[:, None]
    fine_s = np.arange(12) * 0.025
    shown = sampled(*(torch.from_numpy(item) for item in (values, fine_s, rhythm.taken_s(fine_s))))
    np.testing.assert_allclose(shown[:, 0], [0, 0, 0, 0, 4, 4, 4, 4, 4, 4, 10, 10], atol=1e-9)


def test_some_frames_of_held_readings_are_held_as_all_of_them_are() -> None:
    rng = np.random.default_rng(8)
    known = presses()
    lost = [replace(press, signal=dropped(press.signal, 0.4, rng)) for press in known.presses]
    whole = replace(known, presses=tuple(lost))
    thin = held_every(3, whole)
    assert repeated_share(thin) == repeated_share(whole) > 0.3
    assert describe(thin).frame_s == describe(whole).frame_s
    assert describe(thin).ages_s == describe(whole).ages_s
    # Each begins at another frame, and shows there what was taken at one that it may not have.
    model = composite(whole).plus(FORMS[-1], np.array([0.07, 0.0]))
    said = zip(predict(model, whole), predict(model, thin), strict=True)
    for k, (full, some) in enumerate(said):
        np.testing.assert_allclose(some, full[k % 3 :: 3], atol=0.02 * full.max())


def apart(signal: np.ndarray, groups: tuple[int, ...], period_s: float, phases: list[float]) -> np.ndarray:
    """Rows of ten taxels at 20 Hz, each held from the instant of its group."""
    out, time_s = signal.copy(), np.arange(len(signal)) * 0.05
    for row, group in enumerate(groups):
        slot = slots(time_s, period_s, phases[group])
        columns = slice(10 * row, 10 * row + 10)
        out[:, columns] = signal[np.searchsorted(slot, slot, side="left"), columns]
    return out


@pytest.mark.parametrize("groups", [(0, 0, 1, 1, 2, 2), (0, 1, 0, 1, 0, 1)])
@pytest.mark.parametrize("period_s", [0.13, 0.31])
def test_rows_that_are_refreshed_apart_are_found_with_their_period(
    groups: tuple[int, ...], period_s: float
) -> None:
    rng = np.random.default_rng(9)
    raw = [np.round(20.0 * rng.standard_normal((200, 60))) for _ in range(6)]
    seen = press_set([apart(signal, groups, period_s, rng.uniform(0, 1, 3).tolist()) for signal in raw])
    assert groups_apart(seen, 0.05) == groups
    assert periods_apart(seen, 0.05)[0][0] == pytest.approx(period_s, rel=3e-3)
    # In step they are whole frames, also where most rows are so quiet that they miss new readings.
    together = [apart(signal, groups, period_s, [0.3] * 3) for signal in raw]
    assert groups_apart(press_set(together), 0.05) == ()
    for signal in together:
        signal[:, 20:] = np.round(signal[:, 20:] / 80.0)
    assert groups_apart(press_set(together), 0.05) == ()
    # Rows that miss frames at random have no rhythm, and quiet ones that are not held at all neither.
    lost = [np.hstack([dropped(part, 0.5, rng) for part in np.split(signal, 6, axis=1)]) for signal in raw]
    assert groups_apart(press_set(lost), 0.05) == ()
    assert groups_apart(press_set([np.round(signal / 100.0) for signal in raw]), 0.05) == ()


GROUPS, PERIOD_S = (0, 0, 1, 1, 1), 0.13


def held_presses(shift: float, counts: float = 80.0) -> PressSet:
    """Presses that all taxels answer to, whose second group of rows is new a part of a period later."""
    rng = np.random.default_rng(3)
    trials = [trial(number, rng, 120) for number in range(4)]
    for number, each in enumerate(trials):
        each.raw[:] += counts * np.maximum(each.depth_m, 0.0)[:, None] / 6e-4
        for rows, phase in ((slice(0, 16), 0.1), (slice(16, 40), 0.1 + shift)):
            slot = slots(each.time_s, PERIOD_S, phase + 0.2 * number)
            each.raw[:, rows] = each.raw[np.searchsorted(slot, slot, side="left"), rows]
    recordings = RecordingSet(Path(), "pad", 5, 8, 0.002, 255.0, (), tuple(trials))
    return prepare(recordings, trials, [0, 1, 2, 3])


def test_rows_apart_are_predicted_each_at_its_own_instants() -> None:
    known = held_presses(0.5)
    assert describe(known).row_groups == GROUPS
    # Half a period apart, whole frames are new twice as often as rows; in step, as often.
    assert describe(held_presses(0.3)).row_groups == GROUPS
    assert describe(held_presses(0.0)).row_groups == ()
    at_frames, by_clock = (form for form in FORMS if form.possible(describe(known)))
    assert_alone(known, by_clock, next(form for form in FORMS if "trial's start" in form.label))
    assert_alone(known, at_frames, FORMS[-1])


def assert_alone(known: PressSet, form: Form, whole: Form) -> None:
    """Rows of a group show what they would if all of the pad were new when they are."""
    found = predict(composite(known).plus(form, np.array([PERIOD_S])), known)
    for row, number in ((1, 0), (3, 1)):
        alone = [replace(press, trial=press.trial) for press in known.presses]
        for press in alone:
            press.__dict__["rhythm"] = press.rhythm.parts(GROUPS)[number]
        values = np.array([PERIOD_S, 0.0])[: len(whole.values)]
        alike = predict(composite(known).plus(whole, values), replace(known, presses=tuple(alone)))
        for press, some, other in zip(known.presses, found, alike, strict=True):
            mine = press.taxels // 8 == row
            assert mine.any()
            np.testing.assert_array_equal(some[:, mine], other[:, mine])


def test_noise_of_rows_apart_is_that_of_new_readings() -> None:
    known = held_presses(0.5, counts=0.0)
    zeros = [np.zeros_like(press.signal) for press in known.presses]
    noise = fit_frame_noise(known, [press.signal for press in known.presses], zeros, GROUPS)
    assert noise.floor == pytest.approx(0.5, rel=0.1)
