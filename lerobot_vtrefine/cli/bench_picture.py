"""What ``vtrefine-bench --plot`` draws: the contact models' pressure images beside exact ones, and a table.

Every part is pressed on a pad in MuJoCo; all models get the pose and the load that the solver came to.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS
from lerobot_vtrefine.sim.pairs import procedural_pair
from lerobot_vtrefine.sim.press_rig import press
from lerobot_vtrefine.sim.profiles import Primitive as Piece
from lerobot_vtrefine.tactile import BodyGeometry, Box, PadLayout, PadSensors, Poses, SensorModel, Sphere
from lerobot_vtrefine.tactile.geometry import Primitive
from lerobot_vtrefine.tactile.reference import exact_forces
from lerobot_vtrefine.tactile.stages.contact import (
    Consistent,
    ContactStage,
    Depth,
    FlexitacIsaacSim,
    KelvinVoigt,
)

Array = np.ndarray

YAW_RAD = 0.35
TILT_RAD = 0.5
CLEARANCE_M = 0.002
MODELS: dict[str, tuple[ContactStage, str]] = {
    "consistent": (Consistent(), "N"),
    "kelvin_voigt, tacsl": (KelvinVoigt(), "N"),
    "depth": (Depth(), "mm"),
    "flexitac_isaacsim": (FlexitacIsaacSim(), "1"),
}


@dataclass(frozen=True)
class Case:
    """One part pressed on a pad: what each model reads, (R, C) each, and the truth [N]."""

    name: str
    truth: Array
    images: dict[str, Array]

    def force_error(self, model: str) -> float:
        """Relative error of the taxels' sum, for models that give newtons."""
        return float(self.images[model].sum() / self.truth.sum() - 1)

    def misplaced(self, model: str) -> float:
        """Share of the force that the image has in the wrong place, whatever its scale; 1 if it is empty."""
        image, truth = self.images[model], self.truth / self.truth.sum()
        return 1.0 if image.sum() <= 0 else float(np.abs(image / image.sum() - truth).sum() / 2)


def shapes() -> dict[str, tuple[Sequence[Primitive], Array]]:
    """Parts and how they are turned: a sphere, a box on its edge, every pair's plug on its tip."""
    yaw = _turn(2, YAW_RAD)
    parts: dict[str, tuple[Sequence[Primitive], Array]] = {
        "sphere, r = 10 mm": ([Sphere(0.01)], np.eye(3)),
        "box on an edge": ([Box((0.01, 0.008, 0.01))], yaw @ _turn(1, TILT_RAD)),
    }
    for pair in PROCEDURAL_PAIRS:
        pieces: tuple[Piece, ...] = procedural_pair(pair, CLEARANCE_M).plug.pieces
        parts[f"{pair} plug"] = (pieces, yaw)
    return parts


def measure_cases() -> list[Case]:
    """Press all shapes. The penalty's stiffness is fitted on the first, so that it starts out right."""
    layout, stages = PadLayout(), {name: stage for name, (stage, _) in MODELS.items()}
    cases = []
    for name, (pieces, rotation) in shapes().items():
        pressed, body = press(pieces, rotation, (0.001, 0.0)), BodyGeometry(list(pieces))
        poses = Poses(
            *(np.zeros((1, 1, 3)), np.eye(3)[None, None], np.zeros((1, 1, 6))),
            *(pressed.position[None, None], pressed.rotation[None, None], np.zeros((1, 1, 6))),
        )
        if not cases:
            depth = _read(Depth(), layout, body, poses, pressed.load)
            stages["kelvin_voigt, tacsl"] = KelvinVoigt(k_n=float(pressed.load[0] / depth.sum()))
        foundation = Consistent().foundation_n_per_m3
        truth = exact_forces(layout, body, pressed.position, pressed.rotation, foundation, pressed.load)
        images = {model: _read(stage, layout, body, poses, pressed.load) for model, stage in stages.items()}
        cases.append(Case(name, truth, images))
    return cases


def _read(stage: ContactStage, layout: PadLayout, body: BodyGeometry, poses: Poses, load: Array) -> Array:
    model = SensorModel.default().with_stage(stage)
    sensors = PadSensors(layout, [body], 1, 1, model=model)
    return np.asarray(sensors.forces(np.zeros(1, int), poses, 0.1, load[None, None])).reshape(
        layout.rows, layout.cols
    )


def _turn(axis: int, angle: float) -> Array:
    """Rotation matrix about a coordinate axis."""
    matrix, (i, j) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i] = np.sin(angle)
    matrix[i, j] = -matrix[j, i]
    return matrix


def draw(cases: Sequence[Case], path: Path) -> None:
    """Pressure images as a PNG: a row per shape, a column per model."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 1.12 * len(cases) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    for row, (case, line) in enumerate(zip(cases, figure.subplots(len(cases), 5), strict=True)):
        columns = [("truth (Winkler, exact)", case.truth, "N"), *_columns(case)]
        for axes, (title, image, unit) in zip(line, columns, strict=True):
            scale = 1e3 if unit == "mm" else 1.0
            newtons = title in ("consistent", "truth (Winkler, exact)")
            top = case.truth.max() if newtons else image.max() * scale or 1.0
            axes.imshow(image * scale, cmap="viridis", vmin=0, vmax=top, origin="upper")
            axes.set_xticks([])
            axes.set_yticks([])
            if row == 0:
                axes.set_title(title, fontsize=10)
            axes.set_xlabel(_caption(case, title, image * scale, unit), fontsize=7, labelpad=2)
        line[0].set_ylabel(case.name.replace(", ", "\n").replace(" on ", "\non "), fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, format="png")  # captions of 7 points stay readable


def _columns(case: Case) -> list[tuple[str, Array, str]]:
    return [(model, case.images[model], unit) for model, (_, unit) in MODELS.items()]


def _caption(case: Case, model: str, image: Array, unit: str) -> str:
    peak = f"peak {image.max():.3g}" + (f" {unit}" if unit != "1" else "")
    if model not in case.images:
        return f"sum {image.sum():.2f} N, {peak}"
    share = f"{100 * case.misplaced(model):.0f} % misplaced"
    return f"sum {image.sum():.2f} N, {peak}, {share}" if unit == "N" else f"{peak}, {share}"


def table(cases: Sequence[Case], rates: dict[str, float]) -> str:
    """Errors and speeds as a Markdown table.

    Args:
        rates: taxels per second of models and peers by name.
    """
    lines = [
        "| | error of the sum, median (worst) | force in the wrong place, median (worst) "
        "| M taxels/s, one core |",
        "|---|---|---|---|",
    ]
    speeds = {"consistent": "consistent", "kelvin_voigt, tacsl": "kelvin_voigt"}
    for model, (_, unit) in MODELS.items():
        errors = [abs(case.force_error(model)) for case in cases]
        places = [case.misplaced(model) for case in cases]
        total = f"{_percent(np.median(errors))} ({_percent(max(errors))})" if unit == "N" else "no newtons"
        rate = rates.get(speeds.get(model, "kelvin_voigt"))
        speed = f"{rate / 1e6:.0f}" if rate else ""
        lines.append(
            f"| `{model}` | {total} | {_percent(np.median(places))} ({_percent(max(places))}) | {speed} |"
        )
    lines += [
        f"| {name} | | | {rate / 1e6:.1f} |" for name, rate in rates.items() if name not in speeds.values()
    ]
    return "\n".join(lines)


def _percent(share: float | np.floating) -> str:
    return f"{100 * share:.1g} %" if share < 0.001 else f"{100 * share:.3g} %"
