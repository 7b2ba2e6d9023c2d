"""pad_tilt: the pad's face is not parallel to the assumed one."""

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Value
from lerobot_vtrefine.tactile.stages.surface import PadTilt

SMALL_RAD = 2e-3

FORMS = (
    Form(
        "pad_tilt",
        "plane",
        (Value("tilt_x_rad", -0.1, 0.1, 1e-4), Value("tilt_y_rad", -0.1, 0.1, 1e-4)),
        lambda v, s: (PadTilt(float(v[0]), float(v[1])),),
        lambda v, s: {"tilt_x_rad": (float(v[0]), "rad"), "tilt_y_rad": (float(v[1]), "rad")},
        lambda s: [
            probe
            for probe, lines in (([SMALL_RAD, 0.0], s.touched_rows), ([0.0, SMALL_RAD], s.touched_cols))
            if lines > 1
        ],
        amplitude=None,
        kinds=("place",),
        sizes=("tilt_x_rad", "tilt_y_rad"),
        needs="log depth_m, and press at three places or more that are not on a line",
        signed=True,
        possible=lambda s: not s.loaded and max(s.touched_rows, s.touched_cols) > 1,
    ),
)
