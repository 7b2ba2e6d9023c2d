"""Noise predictors eps(x, t, cond): the paper's FiLM U-Net and a small FiLM residual MLP.

Shapes: ``B`` batch, ``H`` horizon, ``D`` action dimension, ``C`` condition. Both are called as
``denoiser(x (B, H, D), t (B,) long, cond (b, C)) -> (B, H, D)``, where each condition belongs to ``B / b``
neighbouring rows: noise draws of one observation, or denoising steps of one decision. FiLM is one Linear per
block, as in DP3.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

GROUPS = 8
DENOISERS = ("unet", "mlp")


class TimeEmbedding(nn.Module):
    """Diffusion step -> features: (B,) -> (B, dim); sinusoids, then a two-layer MLP."""

    rates: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        rates = torch.exp(torch.arange(dim // 2) * (-math.log(1e4) / (dim // 2 - 1)))
        self.register_buffer("rates", rates, persistent=False)
        self.mlp = nn.Sequential(nn.Linear(dim, 4 * dim), nn.Mish(), nn.Linear(4 * dim, dim))

    def forward(self, t: Tensor) -> Tensor:
        """t (B,) long -> (B, dim)."""
        angle = t[:, None] * self.rates
        return self.mlp(torch.cat([angle.sin(), angle.cos()], dim=-1))


def _film_layer(cond_dim: int, time_dim: int, channels: int) -> nn.Sequential:
    """Time features and condition side by side -> scale and bias of ``channels`` features."""
    return nn.Sequential(nn.Mish(), nn.Linear(time_dim + cond_dim, 2 * channels))


def _modulation(film: nn.Sequential, time: Tensor, cond: Tensor) -> Tensor:
    """A FiLM layer of time (B, T) and cond (b, C) -> (B, 2 * channels); a condition's share is computed once
    for the rows that it belongs to.
    """
    if len(cond) == len(time):
        return film(torch.cat([time, cond], dim=-1))
    linear, times = film[1], len(time) // len(cond)
    if type(linear) is not nn.Linear:  # an adapter (--peft.*) takes whole rows
        return film(torch.cat([time, cond.repeat_interleave(times, dim=0)], dim=-1))
    of_time, of_cond = linear.weight.split([time.shape[1], cond.shape[1]], dim=1)
    own = functional.linear(functional.mish(time), of_time, linear.bias)
    shared = functional.linear(functional.mish(cond), of_cond)
    return (own.unflatten(0, (-1, times)) + shared.unsqueeze(1)).flatten(0, 1)


def _conv_block(channels_in: int, channels_out: int, kernel: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv1d(channels_in, channels_out, kernel, padding=kernel // 2),
        nn.GroupNorm(GROUPS, channels_out),
        nn.Mish(),
    )


class ResidualBlock1d(nn.Module):
    """Two convolutions with FiLM after the first, and a skip connection."""

    def __init__(
        self, channels_in: int, channels_out: int, cond_dim: int, time_dim: int, kernel: int
    ) -> None:
        super().__init__()
        self.first = _conv_block(channels_in, channels_out, kernel)
        self.second = _conv_block(channels_out, channels_out, kernel)
        self.film = _film_layer(cond_dim, time_dim, channels_out)
        same = channels_in == channels_out
        self.skip = nn.Identity() if same else nn.Conv1d(channels_in, channels_out, 1)

    def forward(self, x: Tensor, time: Tensor, cond: Tensor) -> Tensor:
        """x (B, channels_in, H), time (B, T), cond (b, C) -> (B, channels_out, H)."""
        scale, bias = _modulation(self.film, time, cond).unsqueeze(-1).chunk(2, dim=1)
        return self.second(self.first(x) * scale + bias) + self.skip(x)


class UNetDenoiser(nn.Module):
    """Conditional 1-D U-Net over the action horizon (Chi et al. 2023; DP3).

    The horizon must be divisible by 2 ** (len(down_dims) - 1).
    """

    def __init__(
        self, action_dim: int, cond_dim: int, down_dims: tuple[int, ...], kernel: int, time_dim: int
    ) -> None:
        super().__init__()
        self.time = TimeEmbedding(time_dim)

        def pair(channels_in: int, channels_out: int) -> nn.ModuleList:
            return nn.ModuleList(
                [
                    ResidualBlock1d(channels_in, channels_out, cond_dim, time_dim, kernel),
                    ResidualBlock1d(channels_out, channels_out, cond_dim, time_dim, kernel),
                ]
            )

        widths = (action_dim, *down_dims)
        stages = range(len(down_dims))
        self.down = nn.ModuleList([pair(widths[i], widths[i + 1]) for i in stages])
        self.shrink = nn.ModuleList([nn.Conv1d(dim, dim, 3, stride=2, padding=1) for dim in down_dims[:-1]])
        self.middle = pair(down_dims[-1], down_dims[-1])
        self.up = nn.ModuleList([pair(2 * down_dims[i], down_dims[i - 1]) for i in reversed(stages[1:])])
        self.grow = nn.ModuleList(
            [nn.ConvTranspose1d(dim, dim, 4, stride=2, padding=1) for dim in reversed(down_dims[:-1])]
        )
        self.head = nn.Sequential(
            _conv_block(down_dims[0], down_dims[0], kernel), nn.Conv1d(down_dims[0], action_dim, 1)
        )

    def forward(self, x: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        """See the module's docstring."""
        time = self.time(t)
        x = x.transpose(1, 2)
        skips: list[Tensor] = []
        for index, stage in enumerate(self.down):
            x = _apply(stage, x, time, cond)
            skips.append(x)
            if index < len(self.shrink):
                x = self.shrink[index](x)
        x = _apply(self.middle, x, time, cond)
        for stage, grow in zip(self.up, self.grow, strict=True):
            x = grow(_apply(stage, torch.cat([x, skips.pop()], dim=1), time, cond))
        return self.head(x).transpose(1, 2)


def _apply(blocks: nn.Module, x: Tensor, time: Tensor, cond: Tensor) -> Tensor:
    for block in blocks.children():
        x = block(x, time, cond)
    return x


class ResidualBlock(nn.Module):
    """Layer norm with FiLM, then a two-layer MLP, added to the input."""

    def __init__(self, width: int, cond_dim: int, time_dim: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.film = _film_layer(cond_dim, time_dim, width)
        self.mlp = nn.Sequential(nn.Linear(width, width), nn.Mish(), nn.Linear(width, width))

    def forward(self, x: Tensor, time: Tensor, cond: Tensor) -> Tensor:
        """x (B, width), time (B, T), cond (b, C) -> (B, width)."""
        scale, bias = _modulation(self.film, time, cond).chunk(2, dim=-1)
        return x + self.mlp(self.norm(x) * (1 + scale) + bias)


class MLPDenoiser(nn.Module):
    """FiLM residual MLP over the flattened chunk: an order of magnitude cheaper than the U-Net on a CPU.

    The output adds the noisy input times a gain that depends on the diffusion step alone: at high noise eps
    is almost x, and without the gain every one of the H * D values would have to pass through ``width``
    features.
    """

    def __init__(
        self, action_dim: int, horizon: int, cond_dim: int, width: int, num_blocks: int, time_dim: int
    ) -> None:
        super().__init__()
        self.time = TimeEmbedding(time_dim)
        self.enter = nn.Linear(horizon * action_dim, width)
        blocks = [ResidualBlock(width, cond_dim, time_dim) for _ in range(num_blocks)]
        self.blocks = nn.ModuleList(blocks)
        self.head = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, horizon * action_dim))
        self.skip = nn.Linear(time_dim, horizon * action_dim)

    def forward(self, x: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        """See the module's docstring."""
        time = self.time(t)
        hidden = _apply(self.blocks, self.enter(x.flatten(1)), time, cond)
        return (self.head(hidden) + self.skip(time) * x.flatten(1)).view_as(x)
