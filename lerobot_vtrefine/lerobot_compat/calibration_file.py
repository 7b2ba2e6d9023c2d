"""Calibrations that a full disk does not take away."""

from pathlib import Path

from lerobot_vtrefine.whole_files import whole_file


class WholeCalibrationFile:
    """Before LeRobot's Robot or Teleoperator among a class's bases: what is saved is there whole or not."""

    calibration_fpath: Path

    def _save_calibration(self, fpath: Path | None = None) -> None:
        """As LeRobot's; a full disk leaves the calibration that was there."""
        with whole_file(self.calibration_fpath if fpath is None else fpath) as part:
            super()._save_calibration(part)  # ty: ignore[missing-attribute]
