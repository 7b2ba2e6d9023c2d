"""Configuration of a FlexiTac pad that poses as a depth camera."""

from dataclasses import dataclass

from lerobot.cameras.configs import CameraConfig

from lerobot_vtrefine.drivers.config import PadConfig


@CameraConfig.register_subclass("flexitac")
@dataclass(kw_only=True)
class FlexitacCameraConfig(CameraConfig, PadConfig):
    """A pad as a depth camera, for robots that take cameras only: raw counts as uint16 "millimetres".

    Record with `--dataset.video=false`: depth is then stored exactly; video would not keep 12 x 32 images.
    All settings of a pad (`PadConfig`) are settings of the camera.

    Attributes:
        use_rgb: Always false.
        use_depth: Always true.
    """

    use_rgb: bool = False
    use_depth: bool = True

    def __post_init__(self) -> None:
        PadConfig.__post_init__(self)
        if self.use_rgb or not self.use_depth:
            raise ValueError("a flexitac camera gives depth only: use_rgb=false, use_depth=true")
        rows, cols = self.pad_shape
        given = (self.height or rows, self.width or cols)
        if given != (rows, cols):
            raise ValueError(
                f"a flexitac camera of this board is {rows} x {cols}, not {given[0]} x {given[1]}"
            )
        self.height, self.width = rows, cols
        self.fps = self.fps or 100
