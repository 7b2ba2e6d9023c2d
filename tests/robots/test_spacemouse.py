"""A SpaceMouse, emulated where easyhid meets the C library: what comes over USB moves the hand rightly."""

import numpy as np
import pytest
from emulated_devices import HidApi

from lerobot_vtrefine.extras import MissingExtraError
from lerobot_vtrefine.lerobot_compat import phases
from lerobot_vtrefine.teleoperators import VtRefineEeConfig
from lerobot_vtrefine.teleoperators.inputs import make_source
from lerobot_vtrefine.teleoperators.vtrefine_ee import VtRefineEe

ARMS = ["left", "right"]
FULL = 350
"""What a Compact reports of a cap that is pushed as far as it goes."""


def opened(**settings: object) -> object:
    source = make_source(VtRefineEeConfig(input="spacemouse", fps=10, key_speed_m_s=0.1, **settings), ARMS)
    source.connect()
    return source


def test_the_cap_moves_and_turns_its_hand_and_the_latest_report_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mouse = HidApi(monkeypatch)
    source = opened(key_speed_rad_s=1.0)
    for _ in range(20):  # faster than hands are moved
        mouse.report(1, FULL, FULL, FULL)
    mouse.report(1, 0, -FULL, 0)  # away from the person
    sample = source.read()["right"]
    np.testing.assert_allclose(sample.position, [0.01, 0, 0], atol=1e-12)
    assert sample.clutch
    mouse.report(1, -FULL, 0, 0)  # to the left
    np.testing.assert_allclose(source.read()["right"].position, [0.01, 0.01, 0], atol=1e-12)
    mouse.report(1, 0, 0, -FULL // 2)  # lifted, by half
    np.testing.assert_allclose(source.read()["right"].position, [0.01, 0.01, 0.005], atol=1e-12)
    mouse.report(1, 20, 20, 20)  # a finger rests
    mouse.report(2, 0, 0, -FULL)  # turned to the left, seen from above
    sample = source.read()["right"]
    np.testing.assert_allclose(sample.position, [0.01, 0.01, 0.005], atol=1e-12)
    np.testing.assert_allclose(sample.rotation[:, 0], [np.cos(0.1), np.sin(0.1), 0], atol=1e-12)
    np.testing.assert_allclose(source.read()["left"].position, 0)
    source.disconnect()


def test_a_press_between_two_looks_is_seen_once(monkeypatch: pytest.MonkeyPatch) -> None:
    mouse = HidApi(monkeypatch, mice=2)
    source = opened(spacemice={"left": 1, "right": 0})
    source.restart({"left": 0.6, "right": 0.6})
    mouse.button(0, down=True, mouse=1)
    mouse.button(0, down=False, mouse=1)
    found = source.read()
    assert (found["left"].grip, found["right"].grip) == (0.0, 0.6)
    mouse.button(0, down=True, mouse=1)
    assert source.read()["left"].grip == 1.0
    assert source.read()["left"].grip == 1.0


def test_one_that_is_pulled_out_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    mouse = HidApi(monkeypatch)
    teleop = VtRefineEe(VtRefineEeConfig(input="spacemouse"))
    teleop.connect()
    teleop.get_action()
    mouse.report(1, 0, 0, -FULL)
    moving = [teleop.get_action() for _ in range(3)]
    assert moving[0] != moving[2]
    mouse.unplugged = True
    teleop.get_action()
    gone = [np.array(list(teleop.get_action().values())) for _ in range(3)]
    np.testing.assert_allclose(gone[2], gone[0], atol=1e-4)
    teleop.disconnect()
    phases.uninstall()


def test_what_is_missing_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    HidApi(monkeypatch, mice=1)
    with pytest.raises(ValueError, match=r"no number 1 for the left hand among 1 plugged in; on Linux"):
        opened(spacemice={"left": 1})
    with pytest.raises(Exception, match="no arm is called middle"):
        VtRefineEeConfig(input="spacemouse", spacemice={"middle": 0})
    with pytest.raises(Exception, match="counts from 0"):
        VtRefineEeConfig(input="spacemouse", spacemice={"left": -1})
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'lerobot_policy_vtrefine\[spacemouse\]'"):
        opened()
