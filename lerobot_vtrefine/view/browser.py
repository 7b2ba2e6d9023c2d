"""The simulation live in a browser: arms and parts, the policy's point cloud, pads, force, success clock.

MuJoCo's geometry is drawn by mjviser, everything beside it by viser. Browsers only look; what the page's
buttons ask for is kept in `Wishes`, which whoever steps the simulation reads.
"""

import contextlib
import copy
import io
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from lerobot_vtrefine.envs.live_world import LiveWorld
from lerobot_vtrefine.extras import VIEW, require
from lerobot_vtrefine.observation import VisuoTactileConfig, build_visuo_tactile
from lerobot_vtrefine.sim.menagerie_meshes import DrawnWorld
from lerobot_vtrefine.tactile.picture import FULL_SCALE, colours
from lerobot_vtrefine.wording import plural

TAXEL_PX, GAP_PX = 5, 8
MOST_PICTURES_HZ = 20.0
"""A browser gets no more pictures a second, however fast the simulation runs."""
POINT_M = 0.0022
CLOUD = VisuoTactileConfig(num_visual_points=512, pixel_stride=1, pool_rows=2, pool_cols=2)
"""Drawn where no policy says what it sees."""
SEEN, FELT = np.array([120, 170, 235]), np.array([255, 96, 32])
EYE_M, LOOK_AT_M = (0.36, 0.06, 0.27), (0.0, 0.06, 0.10)  # left arm on the left


@dataclass
class Wishes:
    """What people asked for on the page; whoever fulfils one clears it."""

    paused: bool = False
    step: bool = False
    reset: bool = False
    seed: int = 0
    record: bool = False


class BrowserView:
    """A page at http://localhost:`port`; the world is drawn at every `update`.

    Args:
        world: what is shown; observe it before every update.
        port: the next free one is taken where it is in use.
        cloud: how the shown point cloud is built; a policy's `observation`, or densely by default.
        controls: whether the page has buttons to pause, step, reset and record.
    """

    def __init__(
        self, world: LiveWorld, port: int, cloud: VisuoTactileConfig | None = None, controls: bool = False
    ) -> None:
        require("the live view", VIEW)
        import mjviser
        import viser

        self._world, self._cloud = world, cloud or replace(CLOUD, embodiment=world.sim.embodiment.name)
        self.wishes = Wishes(seed=world.seed)
        with contextlib.redirect_stdout(io.StringIO()):  # whoever opens the view says its address
            self._server = viser.ViserServer(
                host="127.0.0.1", port=port, label="lerobot_vtrefine", verbose=False
            )
        self._server.initial_camera.position = EYE_M
        self._server.initial_camera.look_at = LOOK_AT_M
        self._drawn = DrawnWorld(world.sim, 0, world.config.menagerie_dir)
        model = copy.deepcopy(self._drawn.model)
        self._scene = mjviser.ViserMujocoScene(self._server, model, num_envs=1)
        self._scene.camera_tracking_enabled = False
        layout = world.sim.embodiment.pad_layout
        self._pad_shape = (layout.rows, layout.cols)
        self._noise = torch.Generator().manual_seed(0)
        self._drawn_s = -np.inf
        self.drawing_s: list[float] = []
        """What each picture cost the simulation."""
        self._add_panel(self._server.gui, controls)
        self.update(now=True)

    @property
    def port(self) -> int:
        """Where the page is."""
        return self._server.get_port()

    @property
    def watched(self) -> bool:
        """Whether a browser shows the page."""
        return bool(self._server.get_clients())

    def update(self, now: bool = False) -> None:
        """Draw the world as it is, unless the last picture is too recent; `now` draws in any case."""
        began = time.perf_counter()
        if not now and began - self._drawn_s < 1.0 / MOST_PICTURES_HZ:
            return
        self._drawn_s = began
        with self._server.atomic():
            self._scene.update_from_mjdata(self._drawn.data())
            self._draw_cloud()
            self._pads.image = self._pad_picture()
            self._tell()
        self._server.flush()
        self.drawing_s.append(time.perf_counter() - began)

    def describe(self) -> str:
        """How many pictures were drawn, and what one costs the simulation."""
        return f"drew {plural(len(self.drawing_s), 'picture')}, {1e3 * np.median(self.drawing_s):.0f} ms each"

    def close(self) -> None:
        """Take the page away."""
        self._server.stop()

    def _add_panel(self, gui: Any, controls: bool) -> None:
        self._status = gui.add_markdown("")
        self._clock = gui.add_progress_bar(0.0)
        if controls:
            self._add_controls(gui)
        self._show_cloud = gui.add_checkbox("point cloud", True)
        gui.add_markdown(
            "Pads: a row per arm (left, right), each with its left and its right finger; fingertips are "
            f"left. Yellow is {FULL_SCALE:.0f} counts above idle or more."
        )
        self._pads = gui.add_image(self._pad_picture())

    def _add_controls(self, gui: Any) -> None:
        wishes = self.wishes

        def toggle(name: str) -> Any:
            def wish(event: Any) -> None:
                setattr(wishes, name, bool(event.target.value))

            return wish

        def ask(name: str) -> Any:
            return lambda _: setattr(wishes, name, True)

        gui.add_checkbox("pause", wishes.paused).on_update(toggle("paused"))
        gui.add_button("step").on_click(ask("step"))
        seed = gui.add_number("seed", wishes.seed, min=0, step=1)
        seed.on_update(lambda event: setattr(wishes, "seed", int(event.target.value)))
        gui.add_button("reset").on_click(ask("reset"))
        gui.add_checkbox("record video", wishes.record).on_update(toggle("record"))

    def _draw_cloud(self) -> None:
        raw = self._world.raw
        keys = ("state", "tactile", "tactile_baseline", "depth_mm", "camera_intrinsics", "camera_pose")
        tensors = [torch.from_numpy(np.asarray(raw[key], np.float32))[None] for key in keys]
        noise = torch.from_numpy(raw["noise_level"])
        cloud = build_visuo_tactile(*tensors, self._cloud, noise_level=noise, generator=self._noise)[
            0
        ].numpy()
        felt = (cloud[:, 4] > 0.5)[:, None]
        strength = np.clip(cloud[:, 3:4], 0.0, 1.0)
        rgb = np.where(felt, 90 + strength * (FELT - 90), SEEN)
        self._server.scene.add_point_cloud(
            "/cloud",
            cloud[:, :3],
            rgb.astype(np.uint8),
            point_size=POINT_M,
            visible=self._show_cloud.value,
            precision="float32",
        )

    def _pad_picture(self) -> np.ndarray:
        """All pads in two columns, uint8 (H, W, 3)."""
        raw, tiles = self._world.raw, []
        for counts, idle in zip(raw["tactile"], raw["tactile_baseline"], strict=True):
            tile = colours(counts.reshape(self._pad_shape), idle.reshape(self._pad_shape))
            tile = tile.repeat(TAXEL_PX, axis=0).repeat(TAXEL_PX, axis=1)
            tiles.append(np.pad(tile, ((0, GAP_PX), (0, GAP_PX), (0, 0)), constant_values=255))
        tiles += [np.full_like(tiles[0], 255)] * (len(tiles) % 2)
        rows = [np.concatenate(tiles[start : start + 2], axis=1) for start in range(0, len(tiles), 2)]
        return np.concatenate(rows)

    def _tell(self) -> None:
        world, sim = self._world, self._world.sim
        named = dict(zip(sim.privileged_names, sim.privileged()[0], strict=True))
        force_n = named["force"] * sim.force_limits_n[0]
        held_s, hold_s = np.nan_to_num(sim.seated_s[0]), sim.config.success.hold_s
        outcome = world.outcome.replace("_", " ").upper() or "running"
        self._status.content = (
            f"**{outcome}** · seed {world.seed} · {world.time_s:.1f} s of "
            f"{sim.episode_steps * sim.config.control_dt_s:.0f} s\n\n"
            f"plug on socket **{force_n:.1f} N** (limit {sim.force_limits_n[0]:.0f} N)\n\n"
            f"seated {held_s:.1f} of {hold_s:.1f} s"
        )
        self._clock.value = 100.0 * min(1.0, held_s / hold_s)
