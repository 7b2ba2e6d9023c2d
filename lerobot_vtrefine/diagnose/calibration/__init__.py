"""Calibration of the paper's contact and readout model from press recordings."""

from lerobot_vtrefine.diagnose.calibration.fit import Calibration, Wanted, calibrate

__all__ = ["Calibration", "Wanted", "calibrate"]
