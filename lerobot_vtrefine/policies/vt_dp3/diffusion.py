"""The diffusion process of ``vt_dp3``: schedule, step grids, one posterior formula, and samplers.

Used by behaviour cloning (``add_noise``), by deployment (``deploy``) and by DPPO (``sample_chain``), so that
all three mean the same process. Shapes: ``B`` batch, ``H`` horizon, ``D`` action dimension, ``K`` denoising
steps of the grid, ``K'`` fine-tuned (last) steps. Positions count along the sampling direction: position 0 is
the noisiest.

Sources: Ho et al. 2020 (DDPM), Song et al. 2021 (DDIM eq. 12, 16), Nichol & Dhariwal 2021 (squared-cosine
schedule), Ren et al. 2024 (DPPO, appendix on noise floors).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lerobot_vtrefine.choices import check_choice

SAMPLERS = ("ddpm", "ddim", "tail")
"""``ddpm``: every training step; ``ddim``: evenly spaced; ``tail``: coarse prefix, then the last steps."""

NOISE_CLIP = 3.0  # DPPO's randn_clip_value: one sample never moves a latent by more than 3 sigma
LOG_PROB_RANGE = (-5.0, 2.0)  # DPPO clamps each element's log-probability before averaging

PredictNoise = Callable[[Tensor, Tensor], Tensor]
"""``(x (B, H, D), t (B,) long) -> eps (B, H, D)``; the condition is bound, as by `predictor`."""


def predictor(denoiser: nn.Module, cond: Tensor) -> PredictNoise:
    """A denoiser with its condition bound."""
    return lambda x, t: denoiser(x, t, cond)


def squaredcos_alpha_bar(num_train_steps: int) -> Tensor:
    """Cumulative signal share of the squared-cosine schedule ("squaredcos_cap_v2").

    Returns: (T,) float64, decreasing; alpha_bar[t] is the share of signal variance at training step t.
    """
    edges = torch.arange(num_train_steps + 1, dtype=torch.float64) / num_train_steps
    curve = torch.cos((edges + 0.008) / 1.008 * math.pi / 2) ** 2
    betas = (1 - curve[1:] / curve[:-1]).clamp(max=0.999)
    return torch.cumprod(1 - betas, dim=0)


def step_grid(sampler: str, num_train_steps: int, num_steps: int, prefix_steps: int = 0) -> tuple[int, ...]:
    """Training steps visited by a sampler, in sampling order (decreasing).

    - ``ddpm``: T-1 ... 0; ``num_steps`` and ``prefix_steps`` do not matter.
    - ``ddim``: ``num_steps`` steps, "leading" spacing: T=100, 5 steps -> 80, 60, 40, 20, 0.
    - ``tail``: ``prefix_steps`` coarse steps, then the last ``num_steps`` of the chain:
      T=100, 10 steps, prefix 5 -> 99, 81, 63, 45, 27, 9, 8, ... 0.
    """
    if sampler == "ddpm":
        return tuple(range(num_train_steps - 1, -1, -1))
    if not 1 <= num_steps <= num_train_steps:
        raise ValueError(f"denoising steps must be within 1..{num_train_steps}, got {num_steps}")
    if sampler == "ddim":
        stride = num_train_steps // num_steps
        return tuple(stride * i for i in range(num_steps - 1, -1, -1))
    check_choice("sampler", sampler, SAMPLERS)
    if not 0 <= prefix_steps <= num_train_steps - num_steps:
        raise ValueError(f"prefix steps must be within 0..{num_train_steps - num_steps}, got {prefix_steps}")
    coarse = torch.linspace(num_train_steps - 1, num_steps - 1, prefix_steps + 1, dtype=torch.float64)
    return tuple(round(t) for t in coarse[:-1].tolist()) + tuple(range(num_steps - 1, -1, -1))


@dataclass(frozen=True)
class DiffusionProcess:
    """A schedule and a step grid, with the reverse step between neighbouring grid steps.

    ``clip_range``: predicted clean actions are clamped to ±clip_range (normalised units).
    """

    num_train_steps: int
    timesteps: tuple[int, ...]
    clip_range: float = 1.0
    _cache: dict[tuple[torch.device, torch.dtype], Tensor] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def num_steps(self) -> int:
        """K, the number of reverse steps."""
        return len(self.timesteps)

    def _tables(self, like: Tensor) -> Tensor:
        """(T + 3K,): alpha_bar, then per position alpha_bar, the next position's, and sigma at eta=1."""
        key = (like.device, like.dtype)
        if key not in self._cache:
            alpha_bar = squaredcos_alpha_bar(self.num_train_steps)
            here = alpha_bar[list(self.timesteps)]
            after = torch.cat([here[1:], torch.ones(1, dtype=torch.float64)])
            sigma = torch.sqrt((1 - after) / (1 - here) * (1 - here / after))
            self._cache[key] = torch.cat([alpha_bar, here, after, sigma]).to(like)
        return self._cache[key]

    def add_noise(self, clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Forward process q(x_t | x_0). clean, noise (B, H, D); t (B,) long training steps -> (B, H, D)."""
        alpha_bar = self._tables(clean)[t].view(-1, 1, 1)
        return alpha_bar.sqrt() * clean + (1 - alpha_bar).sqrt() * noise

    def times(self, positions: Tensor) -> Tensor:
        """Training steps (B,) long of grid positions (B,) long."""
        key = (positions.device, torch.long)
        if key not in self._cache:  # an upload would make every step wait for the device
            self._cache[key] = torch.tensor(self.timesteps, device=positions.device)
        return self._cache[key][positions]

    def posterior(self, x: Tensor, eps: Tensor, positions: Tensor, eta: float) -> tuple[Tensor, Tensor]:
        """Mean (B, H, D) and standard deviation (B, 1, 1) of the next latent.

        DDIM eq. 12 with stochasticity ``eta``; with eta=1 on the ``ddpm`` grid it is the DDPM posterior. The
        noise is recomputed from the clamped clean action, so the mean stays consistent where the clamp is
        active.
        """
        tables, num_steps = self._tables(x), self.num_steps
        here, after, sigma = tables[self.num_train_steps :].view(3, num_steps)[:, positions].view(3, -1, 1, 1)
        clean = (x - (1 - here).sqrt() * eps) / here.sqrt()
        clean = clean.clamp(-self.clip_range, self.clip_range)
        eps = (x - here.sqrt() * clean) / (1 - here).sqrt()
        std = eta * sigma
        mean = after.sqrt() * clean + (1 - after - std**2).clamp(min=0).sqrt() * eps
        return mean, std

    def step(
        self, predict_noise: PredictNoise, x: Tensor, position: int, eta: float
    ) -> tuple[Tensor, Tensor]:
        """``posterior`` for a whole batch at one grid position."""
        positions = torch.full((x.shape[0],), position, dtype=torch.long, device=x.device)
        return self.posterior(x, predict_noise(x, self.times(positions)), positions, eta)


def correlated_noise(white: Tensor, correlation: float) -> Tensor:
    """Unit-variance noise (B, H, D) that is smooth in time: an AR(1) process over H driven by ``white``."""
    if correlation == 0.0:
        return white
    noise, fresh = [white[:, 0]], math.sqrt(1 - correlation**2)
    for step in range(1, white.shape[1]):
        noise.append(correlation * noise[-1] + fresh * white[:, step])
    return torch.stack(noise, dim=1)


def whiten(noise: Tensor, correlation: float) -> Tensor:
    """The white sequence (..., H, D) that ``correlated_noise`` was made from; of a prefix, its prefix."""
    if correlation == 0.0:
        return noise
    steps = (noise[..., 1:, :] - correlation * noise[..., :-1, :]) / math.sqrt(1 - correlation**2)
    return torch.cat([noise[..., :1, :], steps], dim=-2)


def slice_log_prob(
    latent: Tensor, mean: Tensor, std: Tensor, executed: slice, correlation: float = 0.0
) -> Tensor:
    """Average log-probability (B,) per element of the executed part of a latent.

    latent, mean (B, H, D); std broadcastable to them; ``executed`` selects along H the actions that reach the
    environment: the rest of the horizon has no effect on the return and must not enter the ratio. It starts
    at 0. The constant of the ``correlation``'s determinant is left out: it cancels in every ratio.
    """
    white = whiten((latent[:, executed] - mean[:, executed]) / std, correlation)
    log_prob = -0.5 * white**2 - std.log() - 0.5 * math.log(2 * math.pi)
    return log_prob.clamp(*LOG_PROB_RANGE).mean(dim=(1, 2))


class Chain(NamedTuple):
    """The stochastic end of a denoising chain: what DPPO stores per decision."""

    latents: Tensor
    """(B, K'+1, H, D): latents[:, 0] enters the first tuned step, latents[:, -1] is the action chunk."""
    log_probs: Tensor
    """(B, K'): ``slice_log_prob`` of each transition under the sampling policy."""
    means: Tensor
    """(B, K', H, D) means of the transitions."""


@torch.no_grad()
def sample_chain(
    process: DiffusionProcess,
    predict_noise: PredictNoise,
    latent: Tensor,
    *,
    num_tuned: int,
    executed: slice,
    eta: float,
    min_sampling_std: float,
    min_log_prob_std: float,
    correlation: float = 0.0,
    generator: torch.Generator | None = None,
) -> Chain:
    """Sample the last ``num_tuned`` steps with exploration noise.

    latent (B, H, D) is what ``denoise_prefix`` returned. Each step draws
    mean + max(sigma, min_sampling_std) * clip(N(0, 1), ±3); its log-probability uses
    max(sigma, min_log_prob_std). ``correlation`` of the noise from one action of the chunk to the next.
    """
    white = clipped_noise((num_tuned, *latent.shape), latent, generator)
    noise = correlated_noise(white.flatten(0, 1), correlation).view_as(white)
    latents, means, stds = [latent], [], []
    for step, position in enumerate(range(process.num_steps - num_tuned, process.num_steps)):
        mean, std = process.step(predict_noise, latent, position, eta)
        latent = mean + std.clamp(min=min_sampling_std) * noise[step]
        latents.append(latent)
        means.append(mean)
        stds.append(std.clamp(min=min_log_prob_std))
    rows = [torch.cat(parts) for parts in (latents[1:], means, stds)]  # of all steps at once: few kernels
    log_probs = slice_log_prob(*rows, executed, correlation).view(num_tuned, -1).T
    return Chain(torch.stack(latents, dim=1), log_probs.contiguous(), torch.stack(means, dim=1))


@torch.no_grad()
def denoise_prefix(
    process: DiffusionProcess, predict_noise: PredictNoise, noise: Tensor, num_tuned: int
) -> Tensor:
    """Noise-free (eta=0) denoising from pure noise (B, H, D) to the first tuned step.

    The same in DPPO rollouts and in deployment, so the tuned steps meet the latents they were trained on.
    """
    latent = noise
    for position in range(process.num_steps - num_tuned):
        latent, _ = process.step(predict_noise, latent, position, eta=0.0)
    return latent


@torch.no_grad()
def deploy(
    process: DiffusionProcess,
    predict_noise: PredictNoise,
    noise: Tensor,
    *,
    num_tuned: int = 0,
    predict_noise_base: PredictNoise | None = None,
    eta: float = 0.0,
    correlation: float = 0.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The deployment sampler: training's grid without its exploration noise; returns actions (B, H, D).

    ``noise`` (B, H, D) is the standard normal start. With ``num_tuned`` > 0 the steps before the last
    ``num_tuned`` use ``predict_noise_base`` (the frozen network), and the others have stochasticity ``eta``:
    at 0 the result is a deterministic function of ``noise``; at 1 they keep the posterior's own noise, which
    is zero in the last step. The reference evaluates its DDPM policies so, and its DDIM policies with 0.
    ``correlation`` of that noise from one action of the chunk to the next, as in ``sample_chain``.
    """
    base = predict_noise if predict_noise_base is None else predict_noise_base
    latent = denoise_prefix(process, base, noise, num_tuned)
    for position in range(process.num_steps - num_tuned, process.num_steps):
        latent, std = process.step(predict_noise, latent, position, eta)
        if eta > 0:
            white = clipped_noise(latent.shape, latent, generator)
            latent = latent + std * correlated_noise(white, correlation)
    return latent


def clipped_noise(shape: Sequence[int], like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Standard normal noise of a shape, within ±``NOISE_CLIP``; device and type as of ``like``."""
    noise = torch.randn(shape, generator=generator, device=like.device, dtype=like.dtype)
    return noise.clamp(-NOISE_CLIP, NOISE_CLIP)
