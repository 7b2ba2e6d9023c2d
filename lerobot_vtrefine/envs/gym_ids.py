"""The environments under Gymnasium's ids: ``gymnasium.make("lerobot_vtrefine/RoundGrasped-v0")``.

``import lerobot_vtrefine.envs`` registers them; without it, ``"lerobot_vtrefine.envs:"`` before the id does.
Keyword arguments are fields of ``VtRefineEnvConfig``: ``gymnasium.make(..., clearance_m=0.001)``.
"""

from typing import TYPE_CHECKING, Any

import gymnasium

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS, STARTS

if TYPE_CHECKING:
    from lerobot_vtrefine.envs.single_env import VtRefineEnv

NAMESPACE = "lerobot_vtrefine"


def environment_id(pair: str, start: str) -> str:
    """Gymnasium's id of a procedural pair and a start."""
    words = f"{pair}_{start}".split("_")
    return f"{NAMESPACE}/{''.join(word.capitalize() for word in words)}-v0"


def register() -> None:
    """Register an id for every procedural pair and start; idempotent."""
    for pair in PROCEDURAL_PAIRS:
        for start in STARTS:
            name = environment_id(pair, start)
            if name not in gymnasium.registry:
                gymnasium.register(
                    name,
                    entry_point=f"{__name__}:make",
                    kwargs={"pair": pair, "start": start},
                    # Several worlds in one simulation, through Gymnasium's own make_vec.
                    vector_entry_point=f"{__name__}:make_vector",
                )


def make(render_mode: str | None = None, **settings: Any) -> "VtRefineEnv":
    """One environment with these fields of ``VtRefineEnvConfig``."""
    from lerobot_vtrefine.envs.single_env import VtRefineEnv

    _check_render_mode(render_mode)
    env = VtRefineEnv(VtRefineEnvConfig(**settings))
    env.render_mode = render_mode
    return env


def make_vector(num_envs: int, render_mode: str | None = None, **settings: Any) -> gymnasium.vector.VectorEnv:
    """The batched environment with ``num_envs`` worlds."""
    from lerobot_vtrefine.envs.vector_env import VtRefineVectorEnv

    _check_render_mode(render_mode)
    env = VtRefineVectorEnv(VtRefineEnvConfig(**settings), num_envs)
    env.render_mode = render_mode
    return env


def _check_render_mode(mode: str | None) -> None:
    """Gymnasium checks it only where the entry point is a class."""
    if mode is not None:
        check_choice("render_mode", mode, ("rgb_array",), "; vtrefine-play shows it live")
