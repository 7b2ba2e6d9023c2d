"""The ``vt_dp3`` policy: visuo-tactile point clouds to action chunks by diffusion.

Shapes: ``B`` batch, ``To`` observation steps, ``N`` points, ``H`` horizon, ``Ta`` executed actions, ``D``
action dimension, ``C`` condition. All actions in here are normalised; the postprocessor turns them into joint
targets.
"""

import re
from collections import deque
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.policies import PreTrainedPolicy
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.nn import functional

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY, TRUTH_KEY
from lerobot_vtrefine.envs.config import EnvAction
from lerobot_vtrefine.files.weights import naming_full_disk
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.denoisers import MLPDenoiser, UNetDenoiser
from lerobot_vtrefine.policies.vt_dp3.diffusion import DiffusionProcess, PredictNoise, deploy, predictor
from lerobot_vtrefine.policies.vt_dp3.ema import Ema
from lerobot_vtrefine.policies.vt_dp3.observation_encoder import PERCEIVED_KEY, load_encoder, make_encoder
from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import check_stats, widen_narrow_ranges

Batch = dict[str, Tensor]


class VtDp3Model(nn.Module):
    """Observation encoder and noise predictor."""

    def __init__(self, config: VtDp3Config) -> None:
        super().__init__()
        self.encoder = make_encoder(config, config.state_dim)
        cond_dim, action_dim = self.encoder.cond_dim, config.action_dim
        if config.denoiser == "unet":
            self.denoiser: nn.Module = UNetDenoiser(
                action_dim, cond_dim, config.down_dims, config.kernel_size, config.time_dim
            )
        else:
            self.denoiser = MLPDenoiser(
                action_dim,
                config.horizon,
                cond_dim,
                config.down_dims[0],
                len(config.down_dims),
                config.time_dim,
            )
        # Last, so that all else begins the same with it and without.
        self.auxiliary = AuxiliaryHead(cond_dim, config.truth_dim) if config.truth_dim else None

    def encode(self, batch: Batch) -> Tensor:
        """Columns ``encoder.keys`` (B, To, ...) of a processed batch -> condition (B, C)."""
        return self.encoder(batch)


class AuxiliaryHead(nn.Sequential):
    """What a condition (B, C) tells of the truth (B, K), normalised; of no use once cloning is over."""

    WIDTH = 128

    def __init__(self, cond_dim: int, truth_dim: int) -> None:
        super().__init__(nn.Linear(cond_dim, self.WIDTH), nn.ReLU(), nn.Linear(self.WIDTH, truth_dim))

    def loss(self, cond: Tensor, truth: Tensor) -> Tensor:
        """Mean square (B,) of what is told wrongly of the newest frame's truth, out of (B, To, K)."""
        return (self(cond) - truth[:, -1]).square().mean(-1)


class VtDp3Policy(PreTrainedPolicy):
    """LeRobot policy around ``VtDp3Model``.

    ``model`` is what acts: the moving average while behaviour cloning trains ``online``, or the network that
    DPPO tunes. ``base`` is None, or the frozen pre-trained network that does the denoising steps before the
    last ``config.ft_denoising_steps``.
    """

    config_class = VtDp3Config  # ty: ignore[invalid-assignment]
    name = "vt_dp3"  # ty: ignore[invalid-assignment]

    def __init__(
        self,
        config: VtDp3Config,
        dataset_stats: dict[str, Any] | None = None,
        dataset_meta: Any = None,
        read_encoder: bool = True,
    ) -> None:
        """``read_encoder``: start from ``config.pretrained_encoder``; not where weights are loaded anyway."""
        if not isinstance(config, VtDp3Config):
            found = getattr(config, "type", type(config).__name__)
            raise ValueError(f"the checkpoint holds a policy of type '{found}', expected 'vt_dp3'")
        super().__init__(config)
        config.validate_features()
        action = (config.output_features or {})[ACTION_KEY]
        if isinstance(action, EnvAction):  # lerobot-eval
            config.check_fps(action.fps)
            config.check_body(action.body, action.shape[0])
        if dataset_meta is not None:
            config.fps = dataset_meta.fps
            check_stats(config, dataset_meta.stats, dataset_meta.root)
        if dataset_stats:
            # The trainer hands this very dict to the normaliser, also with --policy.path, and offers no other
            # hook.
            widen_narrow_ranges(dataset_stats)
        self.config: VtDp3Config = config
        self.model = VtDp3Model(config)
        if read_encoder and config.pretrained_encoder:
            load_encoder(self.model.encoder, config)
        self.base: VtDp3Model | None = None
        self.online: VtDp3Model | None = None
        self.ema: Ema | None = None
        if config.ft_denoising_steps:
            self._attach_base()
        else:
            for part in self.model.encoder.perception if config.freeze_encoder else ():
                part.requires_grad_(False)
            if config.use_ema:
                self.online = deepcopy(self.model)
                self.model.requires_grad_(False)
                self.ema = Ema(config.ema_power, config.ema_max_decay)
        self.reset()

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **kwargs: Any) -> "VtDp3Policy":
        """Load a checkpoint. Raises: FileNotFoundError if the folder holds no policy, ValueError on its
        type or for damaged weights.
        """
        path = Path(pretrained_name_or_path)
        if path.is_dir() and not (path / "config.json").is_file():
            raise FileNotFoundError(f"{path} holds no policy; give the checkpoint's pretrained_model folder")
        weights = path / SAFETENSORS_SINGLE_FILE
        if weights.is_dir():  # the reader would say "No such device"
            raise IsADirectoryError(f"{weights} is a folder; copy the checkpoint again")
        try:
            policy = super().from_pretrained(pretrained_name_or_path, read_encoder=False, **kwargs)
        except SafetensorError as error:
            raise ValueError(f"the weights of {pretrained_name_or_path} are damaged: {error}") from error
        if policy.config.use_peft:  # the adapters that come next belong to the network that acts
            policy._stop_averaging()
        return policy

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """LeRobot's hook. ``lerobot-train`` would end over a full disk without saying which."""
        with naming_full_disk(save_directory):
            super()._save_pretrained(save_directory, state_dict)

    @classmethod
    def _load_as_safetensor(
        cls, model: "VtDp3Policy", model_file: str, map_location: str, strict: bool
    ) -> "VtDp3Policy":
        """LeRobot's hook. It only logs what is missing, and a base that is missing would act untrained."""
        with safe_open(model_file, framework="pt") as weights:
            names = weights.keys()
        tuned = any(name.startswith("base.") for name in names)
        if tuned != (model.base is not None):
            raise ValueError(
                f"{model_file} is {'a' if tuned else 'not a'} fine-tuned policy: leave out"
                " --policy.ft_denoising_steps, which fine-tuning sets"
            )
        return super()._load_as_safetensor(model, model_file, map_location, strict)

    # LeRobot's hooks for --peft.*

    def _get_default_peft_targets(self) -> dict[str, Any]:
        """Every linear layer and convolution of the network that acts, its encoder included."""
        kinds = (nn.Linear, nn.Conv1d, nn.Conv2d)
        names = [re.escape(name) for name, part in self.model.named_modules() if isinstance(part, kinds)]
        return {"target_modules": rf"model\.({'|'.join(names)})", "modules_to_save": []}

    def _validate_peft_config(self, peft_config: Any) -> None:
        """Called before adapters are put in: from then on they are trained, and no copy is averaged.

        Raises: ValueError without a checkpoint to start from, or for one that DPPO has tuned.
        """
        super()._validate_peft_config(peft_config)
        if self.config.ft_denoising_steps:
            raise ValueError("--peft.* trains by imitation: start from the checkpoint before DPPO")
        self._stop_averaging()

    def _stop_averaging(self) -> None:
        """Let the network that acts be the only one."""
        self.online, self.ema = None, None

    @property
    def process(self) -> DiffusionProcess:
        """The diffusion process that deployment and DPPO use."""
        config = self.config
        return DiffusionProcess(config.num_train_timesteps, config.timesteps, config.clip_sample_range)

    # Training

    def get_optim_params(self) -> Any:
        """Parameters that behaviour cloning trains."""
        return [weight for weight in (self.online or self.model).parameters() if weight.requires_grad]

    def forward(self, batch: Batch, reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Noise-prediction loss of a processed training batch; ``action`` (B, H, D) starts at the current
        frame.

        Actions past the episode's end repeat the last target: with absolute targets that means "hold still".
        ``reduction="none"`` returns one loss per sample (B,).
        """
        if self.config.ft_denoising_steps:
            raise ValueError(
                "a fine-tuned vt_dp3 cannot be trained by behaviour cloning; use the pre-trained checkpoint"
            )
        model = self.online or self.model
        draws = self.config.noise_draws if self.training else 1
        cond = model.encode(self._blurred(model, batch) if self.training else batch)
        clean = batch[ACTION_KEY].repeat_interleave(draws, dim=0)
        noise = torch.randn_like(clean)
        t = torch.randint(self.config.num_train_timesteps, (len(clean),), device=clean.device)
        predicted = model.denoiser(self.process.add_noise(clean, noise, t), t, cond)
        error = functional.mse_loss(predicted, noise, reduction="none").mean(dim=(1, 2))
        loss = error.view(-1, draws).mean(dim=1)
        told: dict[str, float] = {}
        if model.auxiliary is not None:
            missed = model.auxiliary.loss(cond, batch[TRUTH_KEY])
            told = {"auxiliary_loss": missed.mean().item(), "noise_loss": loss.mean().item()}
            loss = loss + self.config.auxiliary_weight * missed
        return (loss if reduction == "none" else loss.mean()), told

    def _blurred(self, model: VtDp3Model, batch: Batch) -> Batch:
        """With ``config.feature_noise`` on the features of cloud and pads."""
        if not self.config.feature_noise:
            return batch
        known = batch.get(PERCEIVED_KEY)
        if known is None:
            known = model.encoder.perceive(model.encoder.inputs(batch))
        spread = known.detach().flatten(0, 1).std(0).nan_to_num()  # of a single frame there is none
        noise = torch.randn_like(known[:, :1]) * spread
        return batch | {PERCEIVED_KEY: known + self.config.feature_noise * noise}

    def update(self) -> None:
        """Called by the trainer after every optimiser step: move the average."""
        if self.ema is not None and self.online is not None:
            self.ema.update(self.model, self.online)

    def prepare_finetuning(
        self,
        sampler: str,
        num_inference_steps: int,
        prefix_steps: int,
        ft_denoising_steps: int,
        eta: float,
        freeze_encoder: bool = False,
    ) -> None:
        """Turn a pre-trained policy into one whose last ``ft_denoising_steps`` denoising steps are trainable.

        ``eta``: stochasticity of these steps when the policy acts.
        The tuned network starts from the averaged weights, a frozen copy does the earlier steps, and the
        average is dropped: what is tuned is what acts. Raises: ValueError if the policy is fine-tuned
        already.
        """
        if self.config.ft_denoising_steps:
            raise ValueError("this checkpoint is fine-tuned already; use the pre-trained one, or resume")
        config = self.config
        config.sampler, config.num_inference_steps = sampler, num_inference_steps
        config.prefix_steps, config.ft_denoising_steps = prefix_steps, ft_denoising_steps
        config.ft_eta = eta
        config.ft_freeze_encoder = freeze_encoder
        if not 1 <= ft_denoising_steps <= len(config.timesteps):
            raise ValueError(f"{ft_denoising_steps=} must be within 1..{len(config.timesteps)}")
        self._stop_averaging()
        self._attach_base()

    def _attach_base(self) -> None:
        """Freeze a copy of ``model`` as ``base``; both share the encoder if that is not tuned."""
        self.model.requires_grad_(True)
        self.base = deepcopy(self.model).requires_grad_(False)
        if self.config.ft_freeze_encoder:
            self.model.encoder.requires_grad_(False)
            self.base.encoder = self.model.encoder

    # Acting

    def reset(self) -> None:
        """Forget observations and planned actions: call it at the start of episodes."""
        self._frames: deque[Batch] = deque(maxlen=self.config.n_obs_steps)
        self._planned: deque[Tensor] = deque()

    def _observe(self, batch: Batch) -> None:
        """Append processed frames (B, ...) to the history; the first one fills it."""
        frame = self.model.encoder.inputs(batch)
        missing = self.config.n_obs_steps - len(self._frames)
        self._frames.extend([frame] * (missing if len(self._frames) == 0 else 1))

    @torch.no_grad()
    def predict_action_chunk(self, batch: Batch, noise: Tensor | None = None, **kwargs: Any) -> Tensor:
        """Actions (B, Ta, D) from now on.

        ``batch`` holds stacked frames (B, To, ...), or single frames (B, ...) that join the history.
        ``noise`` (B, H, D) is the sampler's standard normal start; drawn if not given.
        """
        if batch[STATE_KEY].ndim == 2:
            self._observe(batch)
            batch = self._window()
        return self.sample_actions(batch, noise)[:, : self.config.n_action_steps]

    @torch.no_grad()
    def select_action(self, batch: Batch, noise: Tensor | None = None, **kwargs: Any) -> Tensor:
        """The next action (B, D) for single frames (B, ...); encodes and samples once per chunk."""
        self._observe(batch)
        if not self._planned:
            chunk = self.sample_actions(self._window(), noise)[:, : self.config.n_action_steps]
            self._planned.extend(chunk.unbind(dim=1))
        return self._planned.popleft()

    def _window(self) -> Batch:
        return {key: torch.stack([frame[key] for frame in self._frames], dim=1) for key in self._frames[0]}

    @torch.no_grad()
    def sample_actions(
        self, batch: Batch, noise: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Tensor:
        """The whole horizon (B, H, D) from stacked frames (B, To, ...).

        ``noise`` (B, H, D) is the sampler's standard normal start. It, and the noise of the tuned steps
        (``config.ft_eta``), are drawn from ``generator``, or torch's global one.
        """
        cond = self.model.encode(batch)
        shape = (len(cond), self.config.horizon, self.config.action_dim)
        if noise is None:
            noise = torch.randn(shape, generator=generator, device=cond.device, dtype=cond.dtype)
        base: PredictNoise | None = None
        if self.base is not None:
            cond_base = cond if self.config.ft_freeze_encoder else self.base.encode(batch)
            base = predictor(self.base.denoiser, cond_base)
        return deploy(
            self.process,
            predictor(self.model.denoiser, cond),
            noise,
            num_tuned=self.config.ft_denoising_steps,
            predict_noise_base=base,
            eta=self.config.ft_eta,
            correlation=self.config.ft_noise_correlation,
            generator=generator,
        )
