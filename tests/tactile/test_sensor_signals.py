"""What a signal is between frames, late, and behind a filter: against closed forms."""

import numpy as np
import torch

from lerobot_vtrefine.tactile.stages.signals import delayed, low_passed, sampled


def test_low_pass_of_a_ramp_is_exact_over_any_length() -> None:
    time_s = np.concatenate([np.linspace(0, 1, 11), np.linspace(1.5, 400, 90)])
    tau_s = 0.25
    exact = time_s - tau_s * (1 - np.exp(-time_s / tau_s))
    times = torch.from_numpy(time_s)
    assert np.allclose(low_passed(times[:, None], times, tau_s)[:, 0], exact, atol=1e-9)
    assert low_passed(times[:0, None], times[:0], tau_s).shape == (0, 1)


def test_delay_of_a_ramp_is_a_shift() -> None:
    times = torch.linspace(0, 1, 21, dtype=torch.float64)
    ramp = times[:, None, None].expand(21, 2, 3)
    late = delayed(ramp, times, torch.tensor(0.13))[:, 1, 2]
    assert torch.allclose(late, (times - 0.13).clamp(min=0))
    by_taxel = torch.tensor([[0.0, 0.1, 0.2], [0.0, 0.3, 0.4]])
    late = delayed(ramp, times, by_taxel)
    assert torch.allclose(late, (times[:, None, None] - by_taxel).clamp(min=0), atol=1e-7)


def test_ends_go_on_as_they_are() -> None:
    times, x = torch.tensor([0.0, 1.0, 1.0, 2.0]), torch.tensor([0.0, 1.0, 5.0, 7.0])
    assert sampled(x, times, torch.tensor([-1.0, 0.5, 1.0, 1.5, 9.0])).tolist() == [0.0, 0.5, 5.0, 6.0, 7.0]
    assert sampled(x[:1], times[:1], times).tolist() == [0.0] * 4
