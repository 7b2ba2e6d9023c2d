"""The reference implementation of DPPO, imported from a checkout."""

import contextlib
import functools
import io
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path
from types import ModuleType
from typing import Any

import torch


class Settings(dict[str, Any]):
    """What the reference reads of its configuration: a mapping whose values are attributes, too."""

    __getattr__ = dict.__getitem__


class Reference:
    """The classes of a checkout, imported with stand-ins for what it only configures and logs with.

    Raises: FileNotFoundError where the folder holds no checkout.
    """

    def __init__(self, root: Path) -> None:
        if not (root / "model" / "diffusion" / "diffusion_ppo.py").is_file():
            raise FileNotFoundError(f"--reference={root} is not a checkout of irom-princeton/dppo")
        stubs = {name: ModuleType(name) for name in ("hydra", "omegaconf", "wandb", "env", "env.gym_utils")}
        vars(stubs["hydra"])["utils"] = Settings(instantiate=lambda made: made)
        vars(stubs["omegaconf"])["OmegaConf"] = object
        vars(stubs["env.gym_utils"])["make_async"] = lambda made, **_: made
        sys.modules.update(stubs)
        sys.path.insert(0, str(root))
        from agent.finetune.train_ppo_diffusion_agent import (  # ty: ignore[import-not-found]
            TrainPPODiffusionAgent,
        )
        from model.common.critic import CriticObs  # ty: ignore[import-not-found]
        from model.diffusion import diffusion  # ty: ignore[import-not-found]
        from model.diffusion.diffusion_ppo import PPODiffusion  # ty: ignore[import-not-found]
        from model.diffusion.eta import EtaFixed  # ty: ignore[import-not-found]
        from model.diffusion.mlp_diffusion import DiffusionMLP  # ty: ignore[import-not-found]

        self.Agent, self.Model = TrainPPODiffusionAgent, PPODiffusion
        self.Network, self.Critic, self.Eta = DiffusionMLP, CriticObs, EtaFixed
        self.Imitation, self._diffusion = diffusion.DiffusionModel, diffusion

    @contextlib.contextmanager
    def double_schedule(self) -> Generator[None]:
        """Models made meanwhile have their noise schedule in double precision."""
        single = self._diffusion.cosine_beta_schedule
        self._diffusion.cosine_beta_schedule = functools.partial(single, dtype=torch.float64)
        yield
        self._diffusion.cosine_beta_schedule = single

    def run(self, **settings: Any) -> None:
        """Its agent's own run; the files that it writes and what it prints are dropped."""
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
            self.Agent(Settings(settings, logdir=folder, wandb=None, cond_steps=1)).run()
