"""From the configuration to a running simulation and its episodes; the simulator is imported on first use."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.embodiments import menagerie_file
from lerobot_vtrefine.envs.ablation import make_ablation
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episode_log import EpisodeLog
from lerobot_vtrefine.envs.episodes import Array, Episodes
from lerobot_vtrefine.envs.start_bank import StartBank

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim


def check_count(num_envs: int) -> None:
    """Raises: ValueError for fewer than one environment."""
    if num_envs < 1:
        raise ValueError(f"need at least one environment, got {num_envs} (--eval.batch_size)")


def make_simulation(config: VtRefineEnvConfig, num_envs: int) -> "InsertionSim":
    """The simulation of ``num_envs`` worlds that ``config`` describes.

    Raises:
        ValueError: for zero environments, an unknown pair, clearance, start or backend.
        FileNotFoundError: if a mesh folder or the sensor model file is missing.
    """
    if config.menagerie_dir is not None:  # now, rather than when the first frame is drawn
        menagerie_file(config.body.menagerie, config.body.name, config.menagerie_dir)
    check_count(num_envs)
    from lerobot_vtrefine.sim.simulation import InsertionSim

    return InsertionSim(
        config.scene_config,
        config.task_config,
        config.hidden.sensor_model or config.sensor_model,
        num_envs,
        backend=config.backend,
        num_threads=config.num_threads,
        randomization=config.randomization,
        warp=config.warp,
        robot_faults=config.hidden.robot,
        shear=config.shear,
    )


def make_episodes(config: VtRefineEnvConfig, num_envs: int, on_device: bool = False) -> Episodes:
    """The simulation with ablation, metrics log and colour camera as configured.

    ``on_device``: for a policy that computes where the simulation does, and sees no colour. An ablation takes
    frames of the host all the same.
    """
    ablation = make_ablation(config.ablate, config.ablate_dataset, config.body)
    sim = make_simulation(config, num_envs)
    log = EpisodeLog(config.metrics_path) if config.metrics_path is not None else None
    colour = None if on_device else _colour_camera(config, sim)
    return Episodes(sim, ablation, log, colour, on_device and ablation is None, _start(config, sim))


def _start(config: VtRefineEnvConfig, sim: "InsertionSim") -> Callable[[Array, Array], None] | None:
    if config.start_bank is None:
        return None
    return partial(StartBank.load(config.start_bank, config).start, sim)


def _colour_camera(
    config: VtRefineEnvConfig, sim: "InsertionSim"
) -> Callable[[np.ndarray], np.ndarray] | None:
    if config.colour_size is None:
        return None
    from lerobot_vtrefine.sim.rgb import RgbCamera

    return RgbCamera(sim, *config.colour_size).images
