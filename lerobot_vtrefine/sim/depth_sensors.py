"""What a stereo depth camera makes of true depths, in figures of real ones.

A stereo camera measures disparity: the shift d = f B / z of a point between its two imagers, in pixels.
Noise, steps and systematic error live there, so that errors of depth grow with z^2 / (f B).

Sources, by number:
1. Intel, *Subpixel linearity improvement for D400* (white paper): depth from disparity, 90 degrees for the
   D435, steps of 1/32 pixel.
2. Intel, *Tuning D400 for best performance* (white paper): 848 x 480 is the D435's best resolution.
3. librealsense issue 3904, answered by Intel: RMS 0.032 pixels at best, "best to use about 0.08".
4. librealsense issue 999, answered by Intel: a D435 at 848 x 480 measures from 17 cm, with an RMS below
   0.3 mm at 20 cm.
5. librealsense issue 3314 (D435, 638 pixels at 1280 x 720) and realsense-ros issue 2367 (D405, 382 pixels at
   640 x 480, which has the rows of 848 x 480): focal lengths of single cameras.
6. Intel's data sheet of the D400 series, as quoted in librealsense issues 7806, 11427 and 15016 and by
   DigiKey: baselines 50 and 18 mm; error within 2 % at 2 m (D435) and at 0.5 m (D405); D405 from 70 mm.
7. Keselman et al., *Intel RealSense stereoscopic depth cameras* (2017): Census costs added up over 7 x 7
   pixels in the R200; of the D400 only that it matches semi-globally and preserves edges better.
8. librealsense issue 6691, answered by Intel: filtering a motionless scene over time gains a factor of 3.

No source was found for `edge_px` and none that measures a D405's disparity noise: it has no projector, and
0.08 pixels holds for textured surfaces. Lenses, glare, and surfaces without texture are left out.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class DepthSensor:
    """A stereo depth camera. Pixels are its own, at the resolution at which it computes depth."""

    baseline_m: float
    """Between the left imager, whose view the depth image is, and the right one."""
    focal_px: float
    noise_px: float
    """RMS of the disparity's noise."""
    systematic_px: float
    """Standard deviation, over cameras, of a constant error of the disparity: half of the specified bound."""
    nearest_m: float
    """Nothing nearer is measured."""
    fixed_share: float = 0.1
    """Share of the noise's variance that stays the same through an episode [8]."""
    steps_per_px: int = 32
    """Steps of the disparity [1]."""
    window_px: float = 7.0
    """Side of the square over which a match is made [7]: finer relief and finer noise do not come through."""
    edge_px: float = 1.0
    """RMS displacement of edges in the image."""
    size_px: tuple[int, int] = (848, 480)
    """Width and height of its image [2]."""

    @property
    def pixel_metres(self) -> float:
        """f B: disparity [pixels] times depth [m]."""
        return self.focal_px * self.baseline_m


def systematic_px(share: float, depth_m: float, pixel_metres: float) -> float:
    """Disparity error of which two make the specified bound: this share of the depth, at this depth."""
    return share * pixel_metres / depth_m / 2


DEPTH_SENSORS: dict[str, DepthSensor | None] = {
    "ideal": None,
    "d405": DepthSensor(
        baseline_m=0.018,  # [6]
        focal_px=422.0,  # [5]
        noise_px=0.08,  # [3]
        systematic_px=systematic_px(0.02, 0.5, 422.0 * 0.018),  # [6]
        nearest_m=0.07,  # [6]
    ),
    "d435": DepthSensor(
        baseline_m=0.05,  # [6]
        focal_px=423.0,  # [5], 424 by [1]
        noise_px=0.08,  # [3]
        systematic_px=systematic_px(0.02, 2.0, 423.0 * 0.05),  # [6]
        nearest_m=0.17,  # [4]
    ),
}
"""None for exact depths."""
