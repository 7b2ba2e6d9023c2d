"""Fitting a model under given weights."""

from dataclasses import replace

import numpy as np
from test_engine_forward import composite, presses

from lerobot_vtrefine.diagnose.pad.baseline import plain_weights
from lerobot_vtrefine.diagnose.pad.fitting import predict
from lerobot_vtrefine.diagnose.pad.form_fitting import settle
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet


def uneven_pad() -> PressSet:
    """Presses of a pad whose taxels differ, and each of them noisy in its own way."""
    rng = np.random.default_rng(0)
    held = presses()
    gains = np.exp(rng.normal(0.0, 0.3, (held.layout.rows, held.layout.cols)))
    signals = predict(replace(composite(held), gain_map=gains), held)
    noisy = [signal + rng.normal(0.0, 0.1 * signal.std(), signal.shape) for signal in signals]
    measured = [replace(press, signal=signal) for press, signal in zip(held.presses, noisy, strict=True)]
    return replace(held, presses=tuple(measured))


def test_maps_of_gains_are_fitted_under_the_given_weights() -> None:
    held = uneven_pad()
    plain = plain_weights(held)
    scales = (30.0, 1.0, 0.1)
    uneven = [replace(w, sigma=w.sigma / scale) for w, scale in zip(plain, scales, strict=True)]
    model = replace(composite(held), gain_map=np.ones((held.layout.rows, held.layout.cols)))
    one, other = (settle(model, held, weights) for weights in (plain, uneven))
    assert one.model.gain_map is not None
    assert np.ptp(one.model.gain_map) > 0.1
    assert np.abs(np.asarray(one.model.gain_map) - np.asarray(other.model.gain_map)).max() > 1e-3
