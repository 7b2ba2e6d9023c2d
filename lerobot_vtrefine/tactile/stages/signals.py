"""Recordings as signals that are straight between their frames: at other instants, and through a filter."""

import math
from typing import Any

import numpy as np
import torch

LARGEST_EXPONENT = 200.0
LONGEST_EXPONENT = 600.0
"""Of a single step, after which nothing is left of what was before."""


def share_gone(at_s: torch.Tensor, before_s: torch.Tensor, after_s: torch.Tensor) -> torch.Tensor:
    """Where instants lie between two others, from 0 at the first to 1 at the second; beyond, the nearer's."""
    return (at_s - before_s).div_((after_s - before_s).clamp_(min=1e-12)).clamp_(0.0, 1.0)


def neighbours(times_s: np.ndarray, at_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of every instant the number of the next of at least two known times (T,), and where it lies between it
    and the one before, from 0 to 1; beyond the ends, at the nearer of both."""
    after = np.clip(np.searchsorted(times_s, at_s, "right"), 1, len(times_s) - 1)
    begin = times_s[after - 1]
    share = (at_s - begin) / np.maximum(times_s[after] - begin, 1e-12)
    return after, np.clip(share, 0.0, 1.0, out=share)


def joined(x: np.ndarray, after: np.ndarray, share: np.ndarray) -> np.ndarray:
    """x (T, ...) where `neighbours` says: (K,), or (K, ...) that broadcasts against x's columns."""
    if after.ndim == 1:
        left, right = np.take(x, after - 1, axis=0), np.take(x, after, axis=0)
        share = share.reshape(-1, *(1,) * (x.ndim - 1))
    else:
        # Places in the flat array: NumPy finds these several times as fast as a line per column.
        columns, flat = x[0].size, np.ascontiguousarray(x).ravel()
        place = after * columns + np.arange(columns).reshape(x.shape[1:])
        right = np.take(flat, place)
        place -= columns
        left = np.take(flat, place)
    right -= left
    right *= share.astype(x.dtype, copy=False)
    right += left
    return right


def sampled(x: torch.Tensor, times_s: torch.Tensor, at_s: torch.Tensor) -> torch.Tensor:
    """x (T, ...), known at times (T,), at other instants; the ends go on as they are.

    Instants are (K,), or differ from column to column: (K, ...) that broadcast against x's columns.
    """
    if len(times_s) < 2:
        return x[:1].expand(len(at_s), *x.shape[1:])
    known, seconds, instants = (item.cpu().numpy() for item in (x, times_s, at_s.to(times_s)))
    return torch.from_numpy(joined(known, *neighbours(seconds, instants))).to(x)


def delayed(x: torch.Tensor, times_s: torch.Tensor, delay_s: torch.Tensor) -> torch.Tensor:
    """x (T, ..., R, C) as every taxel was `delay_s` earlier, which broadcasts against (R, C)."""
    if delay_s.numel() == 1:
        return sampled(x, times_s, times_s - delay_s.reshape(()))
    at_s = times_s.view(-1, 1, 1) - delay_s
    return sampled(x, times_s, at_s.view(len(times_s), *(1,) * (x.ndim - 3), *at_s.shape[1:]))


def followed(slow: Any, before: Any, now: Any, dt_s: float, tau_s: Any) -> Any:
    """A one-pole filter's state after a step in which its input went straight from `before` to `now`."""
    if dt_s <= 0.0:
        return slow
    ratio = -dt_s / tau_s
    decay = torch.exp(ratio) if isinstance(ratio, torch.Tensor) else math.exp(ratio)
    ramp = 1.0 - (1.0 - decay) * (tau_s / dt_s)
    return decay * slow + (1.0 - decay) * before + ramp * (now - before)


def low_passed(x: torch.Tensor, times_s: torch.Tensor, tau_s: float) -> torch.Tensor:
    """x (T, ...) through such a filter from rest at zero: `followed` frame by frame, at once."""
    # In NumPy: recordings are short, and its operations take a third of the time to begin.
    known, seconds = (item.to(torch.float64).cpu().numpy() for item in (x, times_s))
    shape, dt = (-1, *(1,) * (x.ndim - 1)), np.diff(seconds)
    decay = np.exp(-dt / tau_s)
    ramp = 1.0 - np.where(dt > 0, (1.0 - decay) * tau_s / np.maximum(dt, 1e-12), 1.0)
    # In place: with memory at hand fits run this on many recordings, one after the other.
    push = known[1:] - known[:-1]
    push *= ramp.reshape(shape)
    push += (1.0 - decay).reshape(shape) * known[:-1]
    slow, begin = np.empty_like(known), 0
    slow[:1] = 0.0
    while begin < len(dt):
        # Growing exponentials instead of a recursion, in pieces short enough not to overflow.
        reach = np.searchsorted(seconds, seconds[begin] + LARGEST_EXPONENT * tau_s, side="right") - 1
        end = min(max(int(reach), begin + 1), len(dt))
        ages = np.minimum((seconds[begin + 1 : end + 1] - seconds[begin]) / tau_s, LONGEST_EXPONENT)
        grow, piece = np.exp(ages).reshape(shape), push[begin:end]
        piece *= grow
        # Torch adds neighbours at once, NumPy column by column.
        after = torch.from_numpy(piece).cumsum(0).numpy()
        after += slow[begin]
        np.divide(after, grow, out=slow[begin + 1 : end + 1])
        begin = end
    return torch.from_numpy(slow).to(x)
