"""Configuration of the ``vt_dp3`` policy: a visuo-tactile 3D diffusion policy (paper appendix, "Pre-
Train").
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.datasets.features import (
    ACTION_KEY,
    CAMERA,
    LIMITS_KEY,
    STATE_KEY,
    TACTILE_PREFIX,
    TRUTH_KEY,
    VISUAL_KEYS,
    baseline_keys,
    tactile_keys,
)
from lerobot_vtrefine.embodiments import embodiment_with_pads, get_embodiment
from lerobot_vtrefine.lerobot_compat import checkpoint_guard, fast_reader
from lerobot_vtrefine.lerobot_compat.config_errors import told_by_lerobot
from lerobot_vtrefine.observation import MODALITIES, VisuoTactileConfig
from lerobot_vtrefine.policies.vt_dp3.denoisers import DENOISERS
from lerobot_vtrefine.policies.vt_dp3.diffusion import step_grid

FUSIONS = ("cloud", "pads")
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "point_dims": (64, 128, 256, 512),
        "denoiser": "unet",
        "down_dims": (512, 1024, 2048),
        "time_dim": 128,
        "noise_draws": 1,
        "optimizer_lr": 1e-4,
        "scheduler_warmup_steps": 500,
        "observation": {"num_visual_points": 512, "pixel_stride": 1, "pool_rows": 1, "pool_cols": 1},
    },
    "small": {
        "point_dims": (32, 64, 128),
        "denoiser": "mlp",
        "down_dims": (256, 256, 256),
        "time_dim": 64,
        "noise_draws": 4,
        "optimizer_lr": 1e-3,
        "scheduler_warmup_steps": 50,
        "observation": {"num_visual_points": 256, "pixel_stride": 1, "pool_rows": 2, "pool_cols": 4},
    },
}
"""What ``preset`` fills in. ``small`` trains on two CPU cores in minutes."""


@PreTrainedConfig.register_subclass("vt_dp3")
@dataclass
class VtDp3Config(PreTrainedConfig):
    """Settings of ``--policy.type=vt_dp3``.

    Fields that are empty or 0 take the preset's value; the saved configuration is always explicit.
    """

    preset: str = "paper"
    """``paper``, or ``small`` for a CPU."""
    modalities: str = "visuo_tactile"
    """``visuo_tactile``, ``visual`` (the paper's baseline) or ``tactile``: what the policy perceives."""
    fusion: str = "cloud"
    """How touch enters: ``cloud``, taxels as points among the visual ones (paper), or ``pads``, each pad as
    an image through a network of its own, which keeps where and how hard it is pressed.
    """

    n_obs_steps: int = 2
    """Frames that it sees: the present one and those before it."""
    horizon: int = 16
    """Actions in a chunk."""
    n_action_steps: int = 8
    """Executed actions per decision; a chunk starts at the current observation."""
    fps: int | None = None
    """Actions per second in the data that it learned from; None in checkpoints that do not say."""

    observation: VisuoTactileConfig = field(default_factory=VisuoTactileConfig)
    point_dims: tuple[int, ...] = ()
    """Widths of the point encoder's shared layers."""
    point_features: int = 64
    """Features of the whole cloud."""
    pad_width: int = 64
    """Features of one pad (``fusion=pads``)."""
    pad_features: int = 64
    """Features of all pads together (``fusion=pads``)."""
    pretrained_encoder: str = ""
    """Start from the encoder that ``vtrefine-information`` trained on simulated contacts: its --output_dir,
    or ``vtrefine:NAME`` for one that comes with this package. Empty: from scratch.
    """
    freeze_encoder: bool = False
    """Behaviour cloning leaves the encoder as it is; needs ``pretrained_encoder``."""
    auxiliary_weight: float = 0.0
    """Weight of an auxiliary loss while cloning: to tell, from what the policy sees, how the parts lie in
    their hands and touch, as ``vtrefine-record-demos --truth=true`` recorded it. 0: none.
    """
    feature_noise: float = 0.0
    """Noise on what cloud and pads are seen as while cloning, in standard deviations over the batch, the same
    for all frames of a sample. From few demonstrations a policy otherwise learns by heart how each one felt.
    """
    denoiser: str = ""
    """``unet`` (paper) or ``mlp``."""
    down_dims: tuple[int, ...] = ()
    """U-Net: channels per stage. MLP: one entry per residual block, all the same width."""
    kernel_size: int = 5
    """U-Net: actions under a kernel of its convolutions."""
    time_dim: int = 0
    """Features of the denoising step."""

    num_train_timesteps: int = 100
    """Denoising steps that are trained; samplers visit all or some of them."""
    noise_draws: int = 0
    """Noise samples per encoded observation in one training step; more than 1 spares the encoder."""
    sampler: str = "ddim"
    """``ddim``, ``ddpm``, or ``tail``: ``prefix_steps`` coarse steps, then the last
    ``num_inference_steps``.
    """
    num_inference_steps: int = 10
    """Steps of ``ddim``, or of the tail proper."""
    prefix_steps: int = 0
    """Coarse steps before the tail."""
    clip_sample_range: float = 1.0
    """Predicted clean actions are clamped to this, in normalised units."""

    ft_denoising_steps: int = 0
    """K': the last denoising steps that DPPO has tuned; the others use the frozen pre-trained network."""
    ft_eta: float = 0.0
    """Stochasticity of the tuned steps when acting: 0 none, 1 the diffusion posterior's, as they were tuned.

    Set by fine-tuning; the last step is noise-free in either case.
    """
    ft_noise_correlation: float = 0.0
    """Of that noise, from one action of a chunk to the next; ``--dppo.noise_correlation`` is practice's."""
    ft_freeze_encoder: bool = False
    """The tuned and the frozen network share one encoder."""

    use_ema: bool = True
    """Keep an exponential moving average of the weights and use it for inference."""
    ema_power: float = 0.75
    """After n updates the average's decay is 1 - (1 + n) ** -``ema_power``."""
    ema_max_decay: float = 0.9999
    """At most."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MIN_MAX,
            "ENV": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
            "VISUAL": NormalizationMode.IDENTITY,
        }
    )
    """How LeRobot scales each kind of feature; clouds and grids of taxels stay as they are."""
    optimizer_lr: float = 0.0
    """Of AdamW, after the warm-up; it falls to zero by the last step."""
    optimizer_betas: tuple[float, float] = (0.95, 0.999)
    """Of AdamW: decay of the averages of gradients and of their squares."""
    optimizer_weight_decay: float = 1e-6
    """Of AdamW."""
    optimizer_grad_clip_norm: float = 10.0
    """Largest norm of a gradient."""
    scheduler_warmup_steps: int = 0
    """Gradient steps over which the learning rate rises."""

    @told_by_lerobot
    def __post_init__(self) -> None:
        super().__post_init__()
        checkpoint_guard.restrict()
        check_choice("policy.preset", self.preset, PRESETS)
        values = dict(PRESETS[self.preset])
        points = values.pop("observation")
        unset = {name: value for name, value in points.items() if not getattr(self.observation, name)}
        self.observation = replace(self.observation, **unset)
        for name, value in values.items():
            setattr(self, name, getattr(self, name) or value)
        self.down_dims, self.point_dims = tuple(self.down_dims), tuple(self.point_dims)
        self._validate()
        fast_reader.install()

    def _validate(self) -> None:
        self.observation.validate()
        for name, choices in (("modalities", MODALITIES), ("fusion", FUSIONS), ("denoiser", DENOISERS)):
            check_choice(f"policy.{name}", getattr(self, name), choices)
        if self.freeze_encoder and not self.pretrained_encoder:
            raise ValueError(
                "policy.freeze_encoder=true needs policy.pretrained_encoder: an untrained one sees nothing"
            )
        if self.auxiliary_weight < 0.0:
            raise ValueError(f"policy.auxiliary_weight must not be negative, got {self.auxiliary_weight}")
        if self.feature_noise < 0.0:
            raise ValueError(f"policy.feature_noise must not be negative, got {self.feature_noise}")
        if not 1 <= self.n_action_steps <= self.horizon:
            raise ValueError(f"policy.n_action_steps={self.n_action_steps} must be within 1..{self.horizon}")
        if self.denoiser == "unet" and self.horizon % 2 ** (len(self.down_dims) - 1):
            raise ValueError(
                f"policy.horizon={self.horizon} must be divisible by {2 ** (len(self.down_dims) - 1)} "
                f"for {len(self.down_dims)} U-Net stages"
            )
        if self.denoiser == "mlp" and len(set(self.down_dims)) > 1:
            raise ValueError(f"policy.down_dims must be one repeated width for the mlp, got {self.down_dims}")
        if not 0.0 <= self.ft_eta <= 1.0:
            raise ValueError(f"policy.ft_eta must lie in [0, 1], got {self.ft_eta}")
        if not 0.0 <= self.ft_noise_correlation < 1.0:
            raise ValueError(
                f"policy.ft_noise_correlation must lie in [0, 1), got {self.ft_noise_correlation}"
            )
        if not 0 <= self.ft_denoising_steps <= len(self.timesteps):
            raise ValueError(
                f"policy.ft_denoising_steps={self.ft_denoising_steps} must be within 0..{len(self.timesteps)}"
            )

    @property
    def sees_grids(self) -> bool:
        """Whether pads enter as images."""
        return self.fusion == "pads" and self.modalities != "visual"

    @property
    def cloud_modalities(self) -> str:
        """What the cloud holds; empty where there is none."""
        if self.fusion == "cloud":
            return self.modalities
        return "" if self.modalities == "tactile" else "visual"

    @property
    def state_dim(self) -> int:
        """Joint positions per frame; known once the features are."""
        return (self.input_features or {})[STATE_KEY].shape[0]

    @property
    def limits_dim(self) -> int:
        """How many limits the data states, which are then seen beside the joints."""
        limits = (self.input_features or {}).get(LIMITS_KEY)
        return 0 if limits is None else limits.shape[0]

    @property
    def truth_dim(self) -> int:
        """Values that the auxiliary loss is about; 0 where there is none."""
        truth = (self.input_features or {}).get(TRUTH_KEY)
        return 0 if truth is None or not self.auxiliary_weight else truth.shape[0]

    @property
    def normalised_keys(self) -> tuple[str, ...]:
        """Columns of what is observed that are normalised."""
        more = ((LIMITS_KEY, self.limits_dim), (TRUTH_KEY, self.truth_dim))
        return (STATE_KEY, *(key for key, size in more if size))

    @property
    def action_dim(self) -> int:
        """Joint targets per action; known once the features are."""
        return (self.output_features or {})[ACTION_KEY].shape[0]

    @property
    def timesteps(self) -> tuple[int, ...]:
        """Training steps visited at inference."""
        return step_grid(self.sampler, self.num_train_timesteps, self.num_inference_steps, self.prefix_steps)

    @property
    def observation_delta_indices(self) -> list[int]:
        """The last ``n_obs_steps`` frames."""
        return list(range(1 - self.n_obs_steps, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        """Chunks start at the current observation, so what DPPO scores is exactly what is executed."""
        return list(range(self.horizon))

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return

    def check_fps(self, fps: float, flag: str = "--env.fps") -> None:
        """Raises: ValueError where ``flag`` would let chunks run at another speed than learned."""
        if self.fps is not None and fps != self.fps:
            raise ValueError(
                f"{flag}={fps:g}, but the policy learned {self.fps} actions a second: give {flag}={self.fps}"
            )

    def check_body(self, name: str, joints: int) -> None:
        """Raises: ValueError for an environment of another robot, or number of joints, than the policy's."""
        if name != (own := self.observation.embodiment):
            raise ValueError(
                f"--env.scene.embodiment={name}, but the policy is of {own}: name an environment of that, or"
                " another --policy.path"
            )
        if joints != self.state_dim:
            raise ValueError(
                f"the policy learned from {self.state_dim} joints, and the environment's robot, {name}, has"
                f" {joints}: name another --policy.path"
            )

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW as in DP3."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            betas=self.optimizer_betas,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineAnnealingWithWarmupSchedulerConfig:
        """Linear warm-up, then cosine to zero over the run's steps."""
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)

    @property
    def required_keys(self) -> tuple[str, ...]:
        """Observation columns that the chosen modalities need."""
        body = get_embodiment(self.observation.embodiment)
        tactile = () if self.modalities == "visual" else (*tactile_keys(body), *baseline_keys(body))
        visual = () if self.modalities == "tactile" else VISUAL_KEYS
        return (STATE_KEY, *tactile, *visual)

    def _way_out(self) -> str:
        """What to do about missing columns."""
        keys = [key for key in self.input_features or {} if key.startswith(TACTILE_PREFIX)]
        body = embodiment_with_pads([key.removeprefix(TACTILE_PREFIX) for key in keys])
        if body is not None and body.name != self.observation.embodiment:
            return f"the data is of {body.name}: set --policy.observation.embodiment={body.name}"
        if set(self.required_keys) - set(self.input_features or {}) <= set(VISUAL_KEYS):
            return (
                f"a robot records them by a depth camera named {CAMERA} (--robot.cameras,"
                " --robot.camera_models); policy.modalities=tactile needs none"
            )
        return "record with vtrefine-record-demos or a tactile robot, or choose other modalities"

    def _check_sizes(self) -> None:
        """Raises: ValueError for a column that holds more or less a frame than the body has of it."""
        body = get_embodiment(self.observation.embodiment)
        pads = (*tactile_keys(body), *baseline_keys(body)) if self.modalities != "visual" else ()
        sizes = dict.fromkeys(
            pads, (body.pad_layout.num_taxels, "a pad's taxels", "policy.modalities=visual")
        )
        if self.cloud_modalities not in ("", "visual"):  # taxels are where the joints put them
            sizes[STATE_KEY] = (
                body.num_joints,
                "its joints",
                "policy.fusion=pads or policy.modalities=visual",
            )
        for key, (wanted, what, way) in sizes.items():
            shape = (self.input_features or {})[key].shape
            if math.prod(shape) != wanted:
                raise ValueError(
                    f"the data's {key} holds {math.prod(shape)} values a frame, and"
                    f" policy.observation.embodiment={body.name} has {wanted} ({what}): name the robot that"
                    f" the data is of, or learn without them by {way}"
                )

    def validate_features(self) -> None:
        """Raises: ValueError naming the columns that a dataset or environment lacks for this policy, or that
        have another size than its robot's.
        """
        missing = [key for key in self.required_keys if key not in (self.input_features or {})]
        if missing:
            shown = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
            raise ValueError(
                f"vt_dp3 with policy.modalities={self.modalities} needs columns that the data lacks: "
                f"{shown}; {self._way_out()}"
            )
        self._check_sizes()
        if self.auxiliary_weight and not self.truth_dim:
            raise ValueError(
                f"policy.auxiliary_weight={self.auxiliary_weight:g} needs {TRUTH_KEY}, which the data lacks:"
                " record with vtrefine-record-demos --truth=true"
            )
        action = (self.output_features or {}).get(ACTION_KEY)
        if action is None or action.type is not FeatureType.ACTION or len(action.shape) != 1:
            raise ValueError(f"vt_dp3 needs a vector feature '{ACTION_KEY}', got {action}")
