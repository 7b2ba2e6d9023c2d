"""DPPO settings: ``paper`` holds the defaults, the other presets state only what differs.

Choose with ``--dppo.type=paper|trust_region|fine|small``, then change single fields, e.g.
``--dppo.epochs=5``.
"""

import math
from dataclasses import dataclass

import draccus

TIMEOUTS = ("terminal", "bootstrap")
ENCODERS = ("trained", "frozen")
MIN_LOG_PROB_STD = 0.055
"""Where a Gaussian's peak density reaches the upper end of diffusion.LOG_PROB_RANGE."""
POSITIVE = (
    *("iterations", "num_envs", "ft_denoising_steps", "epochs", "minibatch_decisions"),
    *("clip", "clip_first", "gamma", "actor_lr", "critic_lr"),
)
"""Settings that must be above 0."""
NOT_NEGATIVE = (
    *("decisions", "minibatches", "micro_batch_decisions", "critic_warmup", "lr_warmup"),
    *("actor_lr_final", "actor_lr_max", "critic_lr_final", "weight_decay", "max_grad_norm"),
    *("min_sampling_std", "kl_coef", "bc_coef", "value_coef", "target_kl", "undo_falls"),
)
"""Settings that may be 0, and not less."""


@dataclass(frozen=True)
class DppoConfig(draccus.ChoiceRegistry):
    """Settings of the DPPO update (Ren et al. 2024), independent of environment and network."""

    # Amount of data: iterations of one episode in each environment (per rank).
    iterations: int = 200
    # Environments that are simulated side by side.
    num_envs: int = 1024
    # Decisions per iteration; 0 means a whole episode. Shorter segments cut episodes, whose rest is
    # bootstrapped.
    decisions: int = 0

    # Sampler of rollouts and deployment: "tail" (coarse frozen prefix, then the last steps), "ddim" or
    # "ddpm".
    sampler: str = "tail"
    # Steps of "ddim", or of the tail proper ("ddpm" takes all).
    sampler_steps: int = 10
    # Coarse steps before the tail ("tail" only); they use the frozen base network.
    prefix_steps: int = 5
    # K': how many of the last steps are fine-tuned.
    ft_denoising_steps: int = 10
    # Stochasticity of the tuned steps in rollouts (1: DDPM posterior).
    eta: float = 1.0
    # Floor of the standard deviation when sampling [normalised action units].
    min_sampling_std: float = 0.01
    # The same in the log-probability.
    min_log_prob_std: float = 0.1
    # Correlation of the exploration noise between neighbouring actions of a chunk; 0 is white noise.
    noise_correlation: float = 0.0

    # Discount per decision.
    gamma: float = 0.999
    # Lambda of generalised advantage estimation (GAE), per decision.
    gae_lambda: float = 0.95
    # Advantage discount per denoising step before the last.
    gamma_denoising: float = 0.99
    # A time-out ends the episode with value zero ("terminal"; the critic must see the time), or keeps the
    # value of the last state ("bootstrap").
    timeout: str = "terminal"
    # Divide rewards by the running deviation of returns.
    reward_scaling: bool = True

    # PPO clip range at the last tuned step.
    # Log-probabilities are averaged over the executed slice: the range of a mean-action shift shrinks with
    # sqrt(Ta * Da).
    clip: float = 1e-3
    # PPO clip range at the first tuned step.
    clip_first: float = 1e-3
    # Rate of the exponential between the two.
    clip_rate: float = 3.0
    # Stop the iteration's update when a minibatch's approximate KL divergence exceeds this.
    target_kl: float = 1.0
    # Trust region: the actor's learning rate is adapted so that an iteration moves the policy by this KL
    # divergence per decision [nats], summed over executed actions and tuned steps, in the deviations of its
    # log-probabilities (min_log_prob_std). It falls geometrically to the final value. 0: the learning rate
    # follows its own schedule. The same step is larger beside quieter exploration: with a third of
    # min_sampling_std, aim at a ninth.
    kl_per_decision: float = 0.0
    # What kl_per_decision falls to by the last iteration.
    kl_per_decision_final: float = 0.0
    # Go back to the policy that succeeded most often so far, and take steps half as large from there, where
    # an iteration's episodes succeed less often by this many standard errors of the difference. The last
    # iteration then only judges the update before it. 0: never.
    undo_falls: float = 0.0
    # Penalty on half the squared shift of mean actions from the frozen base network's, in standard
    # deviations, per action element and tuned step: the KL divergence where noise_correlation is 0.
    kl_coef: float = 0.0
    # Weight of the log-likelihood of chains sampled from the base network (behaviour cloning).
    bc_coef: float = 0.0
    # The critic has its own optimiser; this only matters for its gradient clipping.
    value_coef: float = 0.5

    # Passes over an iteration's data.
    epochs: int = 10
    # Minibatches hold whole decisions: all their tuned steps together. The paper's rows / K'.
    minibatch_decisions: int = 1024
    # Minibatches per epoch; 0: as many as minibatch_decisions makes.
    minibatches: int = 0
    # Decisions per backward pass; gradients accumulate over a minibatch. 0: the whole minibatch at once.
    micro_batch_decisions: int = 0
    # Iterations at the start in which only the critic learns.
    critic_warmup: int = 2
    # Learning rate of the policy at the start.
    actor_lr: float = 1e-5
    # The same at the end.
    actor_lr_final: float = 1e-6
    # Highest rate that the trust region raises it to, unless it starts higher; 0: no limit.
    actor_lr_max: float = 0.0
    # Learning rate of the critic at the start.
    critic_lr: float = 1e-3
    # The same at the end.
    critic_lr_final: float = 1e-3
    # Actor updates over which its learning rate rises linearly.
    lr_warmup: int = 10
    # Of both optimisers.
    weight_decay: float = 0.0
    # Clip the gradient norm of actor and critic; 0 does not clip.
    max_grad_norm: float = 0.0
    # "trained": the observation encoder is fine-tuned too. "frozen": its features are computed once and kept.
    encoder: str = "trained"
    # Features of the critic's layers.
    critic_width: int = 512
    # Residual blocks of the critic.
    critic_blocks: int = 1

    @classmethod
    def default_choice_name(cls) -> str:
        """The preset used without ``--dppo.type``."""
        return "paper"

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value != value:
                raise ValueError(f"--dppo.{name} must be a number, got nan")
        for name in ("gamma", "gae_lambda", "gamma_denoising"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"--dppo.{name} must lie in [0, 1], got {getattr(self, name)}")
        for name in POSITIVE:
            if getattr(self, name) <= 0:
                raise ValueError(f"--dppo.{name} must be positive, got {getattr(self, name)}")
        if not 0.0 <= self.eta <= 1.0:
            raise ValueError(f"--dppo.eta must lie in [0, 1], got {self.eta}")
        if self.min_log_prob_std < MIN_LOG_PROB_STD:
            raise ValueError(
                f"--dppo.min_log_prob_std must be at least {MIN_LOG_PROB_STD}, got {self.min_log_prob_std}: "
                "below it the clamp of log-probabilities removes the gradient"
            )
        if not 0.0 <= self.noise_correlation < 1.0:
            raise ValueError(f"--dppo.noise_correlation must lie in [0, 1), got {self.noise_correlation}")
        if self.kl_per_decision < 0 or (self.kl_per_decision > 0) != (self.kl_per_decision_final > 0):
            raise ValueError(
                "--dppo.kl_per_decision and --dppo.kl_per_decision_final must both be positive, or both 0, "
                f"got {self.kl_per_decision} and {self.kl_per_decision_final}"
            )
        for name in NOT_NEGATIVE:
            if getattr(self, name) < 0:
                raise ValueError(f"--dppo.{name} must not be negative, got {getattr(self, name)}")
        for name, choices in (("timeout", TIMEOUTS), ("encoder", ENCODERS)):
            if getattr(self, name) not in choices:
                raise ValueError(
                    f"--dppo.{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )

    @property
    def deploy_eta(self) -> float:
        """Stochasticity of the tuned steps in deployment, as in the reference's evaluation.

        The steps of the DDPM chain keep their posterior's noise, without the exploration floor; DDIM's keep
        none, since its few long steps would leave too much of it. Success without and with it on the same
        episodes (their number in brackets): trained policies .49, .58 (512), .63, .67 (768), .63, .70 (384);
        a half-trained one .49, .45 (768).
        """
        return 0.0 if self.sampler == "ddim" else self.eta

    def clip_range(self, step: int) -> float:
        """Clip range at tuned step 0 (noisiest) ... K'-1 (last), exponential in between."""
        last = self.ft_denoising_steps - 1
        if last == 0 or self.clip_rate == 0:  # the reference divides 0 by 0 here
            return self.clip
        share = math.expm1(self.clip_rate * step / last) / math.expm1(self.clip_rate)
        return self.clip_first + (self.clip - self.clip_first) * share

    def actor_lr_at(self, iteration: int) -> float:
        """Actor learning rate: zero while the critic warms up, linear rise, cosine to the final value."""
        update = iteration - self.critic_warmup
        if update < 0:
            return 0.0
        if update < self.lr_warmup:
            return self.actor_lr * (update + 1) / self.lr_warmup
        progress = (update - self.lr_warmup) / max(1, self.iterations - self.critic_warmup - self.lr_warmup)
        return _cosine(self.actor_lr, self.actor_lr_final, progress)

    def critic_lr_at(self, iteration: int) -> float:
        """Learning rate of the critic: cosine over all iterations."""
        return _cosine(self.critic_lr, self.critic_lr_final, iteration / self.iterations)


def _cosine(start: float, end: float, progress: float) -> float:
    return end + 0.5 * (start - end) * (1 + math.cos(math.pi * min(progress, 1.0)))


@DppoConfig.register_subclass("paper")
@dataclass(frozen=True)
class PaperDppo(DppoConfig):
    """The paper's setting, with this project's choices where the paper is silent."""


@DppoConfig.register_subclass("trust_region")
@dataclass(frozen=True)
class TrustRegionDppo(DppoConfig):
    """Many environments on a GPU, stable without supervision: a trust region in nats per decision.

    Measured on the round and square pairs, 1024 worlds, one seed a run (docs/learning-tried.md): 12 nats that
    fall to 3 learn fast and without a fall; 40 collapse on the tighter task; 4 and less are as stable and
    slower. On vision alone clipping holds an iteration to 10 nats, whatever the rate: without its limit the
    rate winds up to 1e-2, and success ends 5 points lower (docs/learning-tried.md). Exploration is small and
    smooth in time, so that success while training is near the success of the deployed policy.
    """

    iterations: int = 100
    min_sampling_std: float = 0.03
    min_log_prob_std: float = 0.06
    noise_correlation: float = 0.8
    reward_scaling: bool = False
    clip: float = 0.02
    clip_first: float = 0.02
    kl_per_decision: float = 12.0
    kl_per_decision_final: float = 3.0
    epochs: int = 5
    minibatches: int = 4
    micro_batch_decisions: int = 4096
    critic_warmup: int = 1
    actor_lr: float = 1e-4
    actor_lr_max: float = 2e-4
    max_grad_norm: float = 1.0
    critic_width: int = 256


@DppoConfig.register_subclass("fine")
@dataclass(frozen=True)
class FineDppo(TrustRegionDppo):
    """The trust region for tight or gentle tasks and imitations that often succeed: it explores quietly.

    With touch, on six fresh seeds each of ``cross_gentle`` and of the square pair (18 iterations), it ends at
    97 and 95 %, and no iteration of the last half falls by more than 7 points (docs/learning.md). Where parts
    are picked up from the table first, the trust region as it is learns more (docs/learning-tried.md).
    """

    iterations: int = 12
    min_sampling_std: float = 0.01
    kl_per_decision: float = 5.2
    kl_per_decision_final: float = 1.3
    kl_coef: float = 0.02


@DppoConfig.register_subclass("small")
@dataclass(frozen=True)
class SmallDppo(TrustRegionDppo):
    """The trust region in minutes on two CPU cores: few environments, so smaller steps.

    128 episodes an iteration tell less than 1024: steps of 4 nats that fall to 1. On six seeds of the demo
    (docs/learning-tried.md) no iteration of the last half fell by more than 12 points. Without a bound, even
    with a return to the best weights after a fall, it was up to 41.
    """

    iterations: int = 20
    num_envs: int = 128
    kl_per_decision: float = 4.0
    kl_per_decision_final: float = 1.0
