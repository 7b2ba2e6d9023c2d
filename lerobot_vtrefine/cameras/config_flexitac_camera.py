"""Configuration of a FlexiTac pad that poses as a depth camera."""

from dataclasses import dataclass

from lerobot.cameras.configs import CameraConfig

from lerobot_vtrefine.drivers.config import PadConfig


@CameraConfig.register_subclass("flexitac")
@dataclass(kw_only=True)
class FlexitacCameraConfig(CameraConfig):
    """A pad as a depth camera, for robots that take cameras only: raw counts as uint16 "millimetres".

    Record with `--dataset.video=false`: depth is then stored exactly; video would not keep 12 x 32 images.

    Attributes:
        port: Serial port of the board.
        rows: Rows that the board sends; see PadConfig for this and the following.
        cols: Columns that the board sends.
        pad_rows: Rows of the pad.
        row_offset: Board row that carries the pad's row 0.
        flip_rows: The flat cable is plugged in reversed.
        flip_cols: Columns run from the finger's root to its tip.
        use_rgb: Always false.
        use_depth: Always true.
    """

    port: str
    rows: int = 12
    cols: int = 32
    pad_rows: int | None = None
    row_offset: int = 0
    flip_rows: bool = False
    flip_cols: bool = False
    use_rgb: bool = False
    use_depth: bool = True

    def __post_init__(self) -> None:
        if self.use_rgb or not self.use_depth:
            raise ValueError("a flexitac camera gives depth only: use_rgb=false, use_depth=true")
        rows, cols = self.pad.pad_shape
        given = (self.height or rows, self.width or cols)
        if given != (rows, cols):
            raise ValueError(
                f"a flexitac camera of this board is {rows} x {cols}, not {given[0]} x {given[1]}"
            )
        self.height, self.width = rows, cols
        self.fps = self.fps or 100

    @property
    def pad(self) -> PadConfig:
        """The pad."""
        return PadConfig(
            port=self.port,
            rows=self.rows,
            cols=self.cols,
            pad_rows=self.pad_rows,
            row_offset=self.row_offset,
            flip_rows=self.flip_rows,
            flip_cols=self.flip_cols,
        )
