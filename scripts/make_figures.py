"""Draw the pictures of the documentation from the simulator and from results/: docs/img/.

MUJOCO_GL=egl python scripts/make_figures.py            # all, about two minutes
python scripts/make_figures.py results dppo             # some
MENAGERIE_DIR=mujoco_menagerie python scripts/make_figures.py looks    # needs MuJoCo Menagerie
"""

import json
import os
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lerobot  # noqa: F401  registers the environment
import matplotlib as mpl
import numpy as np
from figures.common import GREY, IMAGES
from figures.learning import draw_dppo, draw_paper, draw_rate, draw_results
from runs.side_by_side import run_one

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.embodiments import ALOHA

PITCH_MM = 2.0
SEED = 3
NAMES = (
    ("left arm", (0.10, 0.62), (0.20, 0.42)),
    ("right arm", (0.90, 0.62), (0.85, 0.33)),
    ("plug", (0.63, 0.52), (0.515, 0.40)),
    ("socket", (0.70, 0.68), (0.50, 0.67)),
    ("fingers with a pad\non each inner face", (0.28, 0.14), (0.56, 0.30)),
)
"""What is called what in the picture of the task: words, their place and what they point at, as shares."""
LOOKS: dict[str, dict[str, Any]] = {
    "aloha": {"lookat_m": (0.0, 0.0, 0.16), "distance_m": 1.25, "azimuth_deg": 165.0},
    "kinova": {"lookat_m": (0.15, 0.0, 0.27), "distance_m": 1.35, "azimuth_deg": 145.0},
}
"""Where each robot is looked at from."""
STYLE: dict[str, Any] = {
    "font.size": 12,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 12,
    "figure.facecolor": "white",
    "savefig.dpi": 110,
    "svg.hashsalt": "vtrefine",
}


def expert_run() -> tuple[Any, list[dict[str, Any]]]:
    """The simulation, and the raw frames of one of the scripted expert's episodes with the state of each."""
    from lerobot_vtrefine.envs import VtRefineEnvConfig
    from lerobot_vtrefine.envs.factory import make_simulation
    from lerobot_vtrefine.sim.demonstrations import Degradation
    from lerobot_vtrefine.sim.expert import ScriptedExpert

    sim = make_simulation(VtRefineEnvConfig(start="grasped", num_threads=1), 1)
    ids = np.array([0])
    expert = ScriptedExpert(sim, Degradation.human_like())
    sim.reset(ids, np.array([SEED]))
    expert.reset(ids)
    frames = []
    for _ in range(sim.episode_steps):
        state = sim.get_state(0)
        raw = {key: value[0].copy() for key, value in sim.observe(ids).items()}
        sim.set_state(0, state)
        action = expert.act(ids)
        frames.append({"raw": raw, "state": state, "action": action[0].copy()})
        result = sim.step(action, ids, images=ids[:0])
        if (result.terminated | result.truncated)[0]:
            break
    return sim, frames


def pressed(raw: dict[str, Any]) -> np.ndarray:
    """Counts above idle (4, 12, 32)."""
    return (raw["tactile"].astype(float) - raw["tactile_baseline"]).clip(0).reshape(4, 12, 32)


def hardest(frames: list[dict[str, Any]]) -> dict[str, Any]:
    """The frame in which the pads feel most beyond the first one's grip."""
    return max(frames, key=lambda frame: np.abs(pressed(frame["raw"]) - pressed(frames[0]["raw"])).sum())


def draw_pads(plt: Any, sim: Any, frames: list[dict[str, Any]]) -> None:
    """Four pads with a scale in millimetres and a colour bar."""
    counts = pressed(hardest(frames)["raw"])
    figure, axes = plt.subplots(2, 2, figsize=(8.6, 4.2), layout="constrained")
    extent = (0.0, 32 * PITCH_MM, 12 * PITCH_MM, 0.0)
    for ax, pad, image in zip(axes.flat, ALOHA.pad_names, counts, strict=True):
        picture = ax.imshow(image, cmap="viridis", vmin=0, vmax=counts.max(), extent=extent)
        ax.set_title(pad.replace("_", " "), loc="left")
    for ax in axes[1]:
        ax.set_xlabel("mm from the fingertip")
    figure.colorbar(picture, ax=axes, label="counts above idle", shrink=0.8)
    figure.savefig(IMAGES / "pads.png")


def draw_task(plt: Any, sim: Any, frames: list[dict[str, Any]]) -> None:
    """The scene with its parts named."""
    from lerobot_vtrefine.sim.render import CameraView, VideoRenderer

    sim.set_state(0, frames[0]["state"])
    view = CameraView(lookat_m=(0.0, 0.0, 0.13), distance_m=0.42, elevation_deg=-12.0)
    renderer = VideoRenderer(sim, 0, view, width=640)
    scene = renderer.frame()[:, :640]
    renderer.close()
    figure, ax = plt.subplots(figsize=(7.4, 4.6), layout="constrained")
    ax.imshow(scene)
    ax.axis("off")
    high, wide = scene.shape[:2]
    for words, (x, y), (to_x, to_y) in NAMES:
        arrow = {"arrowstyle": "-|>", "color": "black", "lw": 1.4}
        place, target = (x * wide, y * high), (to_x * wide, to_y * high)
        box = {"boxstyle": "round,pad=0.25", "fc": "white", "ec": "none", "alpha": 0.85}
        ax.annotate(words, target, place, ha="center", va="center", arrowprops=arrow, bbox=box)
    figure.savefig(IMAGES / "task.png")


def draw_looks(plt: Any) -> None:
    """Both robots by this package's shapes and by MuJoCo Menagerie's meshes."""
    from lerobot_vtrefine.sim.config import SceneConfig
    from lerobot_vtrefine.sim.render import CameraView, VideoRenderer
    from lerobot_vtrefine.sim.simulation import InsertionSim

    folders = {"this package's shapes": None, "Menagerie's meshes": Path(os.environ["MENAGERIE_DIR"])}
    figure, axes = plt.subplots(2, 2, figsize=(8.6, 4.6), layout="constrained")
    for row, (body, view) in zip(axes, LOOKS.items(), strict=True):
        sim = InsertionSim(SceneConfig(embodiment=body, start="grasped"), num_envs=1)
        sim.reset(np.arange(1), np.arange(1))
        for ax, (title, folder) in zip(row, folders.items(), strict=True):
            renderer = VideoRenderer(sim, 0, CameraView(**view), 640, "gl", folder)
            scene = renderer.frame()[:, :640]
            renderer.close()
            ax.imshow(scene[40:-40])
            ax.set_title(f"{body}, {title}", loc="left")
            ax.axis("off")
    figure.savefig(IMAGES / "looks.png")


def draw_point_cloud(plt: Any, sim: Any, frames: list[dict[str, Any]]) -> None:
    """What the policy gets: seen points and taxels in one cloud."""
    import torch

    from lerobot_vtrefine.observation.visuo_tactile import VisuoTactileConfig, build_visuo_tactile

    raw = {key: torch.as_tensor(np.asarray(value)) for key, value in hardest(frames)["raw"].items()}
    intrinsics = torch.as_tensor(np.asarray(sim.camera_intrinsics), dtype=torch.float32).reshape(4)
    pose = torch.as_tensor(np.asarray(sim.camera_pose), dtype=torch.float32).reshape(7)
    cloud = build_visuo_tactile(
        raw["state"],
        raw["tactile"].reshape(4, -1),
        raw["tactile_baseline"].reshape(4, -1),
        raw["depth_mm"],
        intrinsics,
        pose,
        VisuoTactileConfig(num_visual_points=512, pixel_stride=1, pool_rows=1, pool_cols=1),
        generator=torch.Generator().manual_seed(0),
    ).numpy()
    figure = plt.figure(figsize=(7.4, 5.0), layout="constrained")
    ax = figure.add_subplot(projection="3d")
    seen, felt = cloud[cloud[:, 4] == 0], cloud[cloud[:, 4] == 1]
    ax.scatter(*(100 * seen[:, :3].T), s=7, color=GREY, label=f"{len(seen)} seen points")
    dots = ax.scatter(*(100 * felt[:, :3].T), s=14, c=felt[:, 3], cmap="viridis", label=f"{len(felt)} taxels")
    figure.colorbar(dots, label="reading, normalised", shrink=0.6)
    ax.set(xlabel="x [cm]", ylabel="y [cm]", zlabel="z [cm]")
    ax.view_init(22, -160)
    ax.set_aspect("equal")
    ax.legend(loc="upper left")
    figure.savefig(IMAGES / "point_cloud.png")


def draw_depth_sensors(plt: Any) -> None:
    """The same moment by an exact camera and by two stereo cameras."""
    from lerobot_vtrefine.envs import VtRefineEnvConfig
    from lerobot_vtrefine.envs.factory import make_simulation
    from lerobot_vtrefine.sim.config import SceneConfig

    titles = {"ideal": "ideal", "d435": "RealSense D435", "d405": "RealSense D405"}
    figure, axes = plt.subplots(1, 3, figsize=(10.4, 2.9), layout="constrained")
    for ax, (name, title) in zip(axes, titles.items(), strict=True):
        scene = SceneConfig(start="grasped", depth_sensor=name)
        sim = make_simulation(VtRefineEnvConfig(scene=scene, num_threads=1), 1)
        sim.reset(np.array([0]), np.array([SEED]))
        depth = sim.depth_mm()[0].astype(float)
        picture = ax.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis", vmin=430, vmax=640)
        ax.set_title(title, loc="left")
        ax.axis("off")
    figure.colorbar(picture, ax=axes, label="depth [mm]", shrink=0.9)
    figure.savefig(IMAGES / "depth_sensors.png")


def draw_policy(plt: Any, sim: Any, frames: list[dict[str, Any]]) -> None:
    """A chunk of the expert's actions at several levels of noise, as diffusion sees it."""
    chunk = np.stack([frame["action"] for frame in frames])[:16, 7:13]
    low, high = chunk.min(axis=0), chunk.max(axis=0)
    centred = 2 * (chunk - low) / np.maximum(high - low, 1e-9) - 1
    noise = np.random.default_rng(0).standard_normal(centred.shape)
    figure, axes = plt.subplots(1, 4, figsize=(9.4, 2.7), sharey=True, layout="constrained")
    for ax, left in zip(axes, (1.0, 0.6, 0.25, 0.0), strict=True):
        for joint, line in enumerate((np.sqrt(1 - left) * centred + np.sqrt(left) * noise).T):
            ax.plot(line, lw=1.6, color=mpl.colormaps["viridis"](joint / 6))
        ax.set_title("noise only" if left == 1 else "actions" if left == 0 else f"{100 * left:.0f} % noise")
        ax.set_xlabel("control step")
    axes[0].set_ylabel("right arm's joints,\nnormalised")
    figure.savefig(IMAGES / "policy.png")


def draw_diagnosis(plt: Any) -> None:
    """One press as it was measured, as the plain model has it, and as the repaired one has it."""
    import pyarrow.parquet as pq

    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        presses, out = work / "presses", work / "out"
        command("press", f"--output_dir={presses}")
        command("diagnose", f"--recording={presses}", f"--output_dir={out}")
        for name in ("baseline", "sensor"):
            model = f"--sensor_model={out / f'{name}_model.json'}"
            command("predict", f"--recording={presses}", model, f"--output_dir={work / name}")
        trials = json.loads((presses / "recording.json").read_text(encoding="utf-8"))["trials"]
        flat = next(trial["file"] for trial in trials if trial["object"]["shape"] == "flat")
        images = [
            np.stack(pq.read_table(work / name / flat)["raw"].to_numpy()).astype(float)
            for name in ("presses", "baseline", "sensor")
        ]
    frame = int(images[0].sum(axis=1).argmax())
    idle = images[0][:3].mean(axis=0)
    measured, plain, repaired = [(image[frame] - idle).reshape(12, 32).clip(0) for image in images]
    top = measured.max()
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 2.3), layout="constrained")
    titles = ("measured", f"simulated: off by {rms(plain - measured):.1f} counts")
    titles += (f"with the cause named: {rms(repaired - measured):.1f} counts",)
    for ax, title, image in zip(axes, titles, (measured, plain, repaired), strict=True):
        picture = ax.imshow(image, cmap="viridis", vmin=0, vmax=top, extent=(0, 64, 24, 0))
        ax.set_title(title, loc="left", fontsize=11)
        ax.set_xlabel("mm")
    figure.colorbar(picture, ax=axes, label="counts above idle", shrink=0.9)
    figure.savefig(IMAGES / "diagnosis.png")


def command(name: str, *arguments: str) -> None:
    """Run one of this package's commands."""
    run_one([sys.executable, "-m", f"lerobot_vtrefine.cli.{name}", *arguments])


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


SIMULATED: dict[str, Callable[..., None]] = {
    "pads": draw_pads,
    "task": draw_task,
    "point_cloud": draw_point_cloud,
    "policy": draw_policy,
}
OTHERS: dict[str, Callable[..., None]] = {
    "depth_sensors": draw_depth_sensors,
    "dppo": draw_dppo,
    "rate": draw_rate,
    **{table: partial(draw_paper, table=table) for table in ("paper", "paper_pads")},
    "results": draw_results,
    "diagnosis": draw_diagnosis,
    "looks": draw_looks,
}


@run_cli
def main() -> None:
    """Draw what is asked for."""
    parser = CommandParser(description=__doc__)
    choices = (*SIMULATED, *OTHERS)
    parser.add_argument("pictures", nargs="*", metavar="PICTURE", help=f"of {', '.join(choices)}")
    wanted = parser.parse_args().pictures
    if unknown := set(wanted) - set(choices):
        raise ValueError(f"unknown {', '.join(sorted(unknown))}; choose from {', '.join(choices)}")
    mpl.use("Agg")
    mpl.rcParams.update(STYLE)  # ty: ignore[no-matching-overload]
    import matplotlib.pyplot as plt

    wanted = wanted or [name for name in choices if name != "looks" or "MENAGERIE_DIR" in os.environ]
    IMAGES.mkdir(parents=True, exist_ok=True)
    run = expert_run() if SIMULATED.keys() & set(wanted) else None
    for name in wanted:
        OTHERS[name](plt) if name in OTHERS else SIMULATED[name](plt, *(run or ()))
        print(name, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
