"""Where the taxels of a pad sit: a planar lattice, centred on the pad's face."""

from dataclasses import dataclass

import numpy as np

MARGIN_M = 1e-3
"""Between the outer taxels' centres and the edges of their pad's face."""


@dataclass(frozen=True)
class PadLayout:
    """A lattice of rows x cols taxels on a flat face.

    The pad frame has its origin at the centre of the undeformed face, +x along increasing column, +y along
    increasing row and +z outward. Taxel (r, c) sits at ((c - (C-1)/2) pitch, (r - (R-1)/2) pitch, 0).
    """

    rows: int = 12
    cols: int = 32
    pitch_m: float = 0.002

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1:
            raise ValueError(f"a pad needs at least one row and one column, got {self.rows} x {self.cols}")
        if not (np.isfinite(self.pitch_m) and self.pitch_m > 0.0):
            raise ValueError(f"pitch_m must be positive, got {self.pitch_m}")

    @property
    def num_taxels(self) -> int:
        """rows * cols."""
        return self.rows * self.cols

    @property
    def taxel_area_m2(self) -> float:
        """Area that one taxel stands for [m^2]."""
        return self.pitch_m**2

    @property
    def radius_m(self) -> float:
        """Distance from the centre to the outer corner of the lattice's cells [m]."""
        return 0.5 * self.pitch_m * float(np.hypot(self.rows, self.cols))

    def check_fits(self, length_m: float, width_m: float) -> None:
        """Raises: ValueError for a face of this extent along columns and rows with too little room around."""
        sides = [(count - 1) * self.pitch_m + 2 * MARGIN_M for count in (self.cols, self.rows)]
        if sides[0] > length_m + 1e-9 or sides[1] > width_m + 1e-9:
            raise ValueError(
                f"a pad's face is {1e3 * length_m:.1f} x {1e3 * width_m:.1f} mm, but its {self.rows} x"
                f" {self.cols} taxels at {1e3 * self.pitch_m:g} mm need"
                f" {1e3 * sides[0]:.1f} x {1e3 * sides[1]:.1f} mm"
            )

    def axes_m(self) -> tuple[np.ndarray, np.ndarray]:
        """x of every column (C,) and y of every row (R,) [m]."""
        x = (np.arange(self.cols) - (self.cols - 1) / 2) * self.pitch_m
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch_m
        return x, y

    def positions(self) -> np.ndarray:
        """Taxel centres in the pad frame, row-major: (R*C, 3) [m]."""
        x, y = self.axes_m()
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x, grid_y, np.zeros_like(grid_x)], axis=-1).reshape(-1, 3)
