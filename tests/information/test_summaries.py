"""How errors of many frames become one figure: episodes weigh alike in one, frames in the other."""

import numpy as np
import pytest
import torch
from test_information import JOINTS, synthetic

from lerobot_vtrefine.information.contact import TOUCHING, summarise
from lerobot_vtrefine.information.estimator import episode_errors, rms_with_interval
from lerobot_vtrefine.information.frames import Frames
from lerobot_vtrefine.information.study import _spread


def uneven(quantity: torch.Tensor) -> Frames:
    """Episodes of 2 and of 9 frames by turns, longer ones with a larger spread of ``quantity`` (E, T)."""
    frames = synthetic(0)
    frames.length[0::2], frames.length[1::2] = 2, 9
    frames.held[:] = torch.arange(frames.truth.shape[1]) < frames.length[:, None]
    frames.truth[:] = 0.0
    frames.truth[..., 0] = quantity * torch.where(frames.length > 2, 3.0, 1.0)[:, None]
    return frames


class KnowsNothing(torch.nn.Module):
    """An estimator that always names the mean."""

    def __init__(self, mean: torch.Tensor) -> None:
        super().__init__()
        self.mean = mean

    def window(self, frames: Frames, episode: torch.Tensor, frame: torch.Tensor) -> torch.Tensor:
        return frames.columns["state"][episode, frame]

    def forward(self, window: torch.Tensor) -> torch.Tensor:
        assert window.shape[1:] == (JOINTS,)
        return self.mean.expand(len(window), -1)


def test_one_who_knows_nothing_errs_by_what_is_told_of_the_unseen() -> None:
    """Long episodes weighed more in what he should err by: a constant seemed to know something."""
    frames = uneven(torch.randn(60, 9, generator=torch.Generator().manual_seed(1)))
    held = frames.held[..., None]
    mean = ((frames.truth * held).sum(1) / held.sum(1)).mean(0)
    value, *_ = rms_with_interval(episode_errors(KnowsNothing(mean), frames))  # type: ignore[arg-type]
    assert float(value[0]) == pytest.approx(float(_spread(frames)[0]), rel=1e-4)
    pooled = float(np.std(frames.truth[frames.held_index()][:, 0].numpy()))
    assert pooled > 1.1 * float(value[0])  # what was told before


def test_a_share_of_frames_is_no_mean_of_shares_of_episodes() -> None:
    right, judged = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 3.0])
    found = summarise({TOUCHING: (right, judged)}, torch.zeros(4, 4), seed=0)
    assert found.told[TOUCHING][0] == 0.25
