"""How one control step changes an episode: grasp, success, failure, as pure functions without a simulator.

Parts are ordered socket, plug; ALOHA's first hand holds the socket, its second one the plug.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim import task
from lerobot_vtrefine.sim.backends.base import LOAD_SIZE
from lerobot_vtrefine.sim.config import LimitsConfig, SuccessConfig, TaskConfig
from lerobot_vtrefine.sim.episode import EpisodeState, Measured, update
from lerobot_vtrefine.sim.substeps import Substeps

ONE = np.array([0])
SCENE = SimpleNamespace(embodiment=ALOHA, holders=ALOHA.holders, model=SimpleNamespace(nu=14))
RULES = TaskConfig(
    control_hz=10.0,
    success=SuccessConfig(hold_s=0.2),
    limits=LimitsConfig(in_hand_shift_m=0.005, contact_force_n=20.0, drop_s=0.3),
)
HELD = (5.0, 5.0, 5.0, 5.0)
"""Normal force on the pads [N]: two of the socket's hand, two of the plug's."""


def measured(
    seated: bool = False,
    pads: tuple[float, ...] = HELD,
    force_n: float = 0.0,
    shift_m: float = 0.0,
    height_m: float = 0.1,
    position: tuple[float, float, float] = (0.0, 0.0, 0.2),
    diverged: bool = False,
) -> Measured:
    """One world in which everything is as it should be, but for what is given."""
    zero, load = np.zeros(1), np.zeros((1, 4, LOAD_SIZE))
    load[0, :, 0] = pads
    remaining = np.array([0.0 if seated else 0.02])
    insertion = task.Insertion(
        np.zeros((1, 3)), np.eye(3)[None], -remaining, remaining, zero, zero, np.full(1, 0.2)
    )
    grips = np.zeros((1, 2, 2, 3))
    grips[0, 1, :, 2] = shift_m
    none, nowhere = np.zeros((1, 3)), np.zeros((1, 4))
    summary = Substeps(np.array([force_n]), np.zeros((1, 3, 3)), none, none, zero, nowhere)
    return Measured(
        insertion,
        grips,
        np.full((1, 2), height_m),
        np.array([[position, position]]),
        summary,
        load,
        np.array([diverged]),
        np.array([False]),
    )


def begun() -> EpisodeState:
    """An episode whose parts are in hand."""
    state = EpisodeState.empty(SCENE, 1, 4)
    state.clear(ONE)
    state.grasped[:] = True
    state.force_limit[:] = RULES.limits.contact_force_n
    return state


def run(state: EpisodeState, *steps: Measured) -> list[float]:
    """Rewards of control steps."""
    return [float(update(state, ONE, seen, RULES, SCENE)[0]) for seen in steps]


def failure(state: EpisodeState) -> str:
    return task.FAILURES[state.failure[0]]


def test_success_comes_once_after_an_unbroken_hold() -> None:
    state, yes, no = begun(), measured(seated=True), measured()
    assert run(state, yes, yes, no, yes, yes, yes, yes) == [0, 0, 0, 0, 0, 1, 0]
    assert state.success[0]
    assert state.done[0]
    assert state.success_step[0] == 6
    assert state.seated_s(0.1)[0] == pytest.approx(0.3)
    assert np.isnan(begun().seated_s(0.1)[0])


def test_a_failure_in_the_step_of_success_is_no_success() -> None:
    state, yes = begun(), measured(seated=True)
    assert run(state, yes, yes, measured(seated=True, force_n=21.0)) == [0, 0, 0]
    assert failure(state) == "contact_force"
    assert not state.success[0]
    assert state.success_step[0] == -1


def test_what_follows_success_does_not_undo_it() -> None:
    state = begun()
    run(state, *[measured(seated=True)] * 3, measured(force_n=99.0, shift_m=0.1))
    assert (state.success[0], failure(state)) == (True, "none")


@pytest.mark.parametrize(
    ("seen", "reason"),
    [
        (measured(force_n=20.1), "contact_force"),
        (measured(shift_m=0.0051), "in_hand_shift"),
        (measured(shift_m=-0.0051), "in_hand_shift"),
        (measured(position=(0.36, 0.0, 0.2)), "dropped"),
        (measured(position=(0.0, -0.41, 0.2)), "dropped"),
        (measured(position=(0.0, 0.0, 0.61)), "dropped"),
        (measured(height_m=-0.021), "dropped"),
        (measured(diverged=True, force_n=99.0), "unstable"),
        (measured(force_n=float("nan")), "unstable"),
        (measured(force_n=99.0, shift_m=0.1), "in_hand_shift"),
        (measured(force_n=19.9, shift_m=0.0049, position=(0.34, 0.39, 0.59)), "none"),
    ],
)
def test_limits_end_an_episode_for_the_first_reason(seen: Measured, reason: str) -> None:
    state = begun()
    run(state, seen)
    assert failure(state) == reason
    assert state.done[0] == (reason != "none")
    assert np.isfinite(state.peak_force[0])


@pytest.mark.parametrize("pads", [(5, 5, 5, 0.9), (5, 5, 0.9, 5), (0.9, 5, 5, 5), (5, 5, 0, 0)])
def test_a_part_is_held_while_both_pads_of_its_hand_press(pads: tuple[float, ...]) -> None:
    """Three steps of 0.1 s are what a lifted part may stay unheld."""
    state = begun()
    run(state, measured(pads=pads), measured(pads=pads))
    assert failure(state) == "none"
    run(state, measured(pads=pads))
    assert failure(state) == "dropped"
    state = begun()
    run(state, *[measured(pads=pads)] * 2, measured(pads=(1.1, 1.1, 1.1, 1.1)), *[measured(pads=pads)] * 2)
    assert failure(state) == "none"


def test_a_part_on_the_table_may_be_let_go_and_gripped_anew() -> None:
    state = begun()
    run(state, *[measured(pads=(0, 0, 0, 0), height_m=0.0)] * 5)
    assert (failure(state), state.grasped[0].tolist()) == ("none", [False, False])
    shifted = measured(shift_m=0.03, height_m=0.0)
    run(state, shifted, shifted)
    assert state.grasped[0].tolist() == [False, False]
    run(state, shifted)  # 0.3 s of grip: its place in the hand is the reference from now on
    assert state.grasped[0].tolist() == [True, True]
    assert state.shift[0].tolist() == [0.0, 0.0]
    run(state, measured(shift_m=0.033))
    assert state.shift[0].tolist() == pytest.approx([0.0, 0.003])
    assert failure(state) == "none"


def test_a_lifted_part_keeps_its_reference_while_it_slips() -> None:
    state = begun()
    run(state, measured(pads=(5, 5, 0, 0)), measured(shift_m=0.002), measured(shift_m=0.001))
    assert state.shift[0].tolist() == pytest.approx([0.0, 0.001])
    assert state.largest_shift[0].tolist() == pytest.approx([0.0, 0.002])


def test_peaks_are_of_the_episode_and_tails_of_the_step() -> None:
    state = begun()
    run(state, measured(force_n=7.0), measured(force_n=3.0))
    assert (state.step_force[0], state.peak_force[0], state.steps[0]) == (3.0, 7.0, 2)
    assert state.pad_force[0].tolist() == list(HELD)


def test_worlds_that_are_not_addressed_stay_as_they_are() -> None:
    state = EpisodeState.empty(SCENE, 2, 4)
    state.force_limit[:] = RULES.limits.contact_force_n
    update(state, np.array([1]), measured(force_n=50.0), RULES, SCENE)
    assert state.steps.tolist() == [0, 1]
    assert state.done.tolist() == [False, True]
