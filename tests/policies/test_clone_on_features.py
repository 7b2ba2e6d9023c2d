"""Cloning on features: the same loss as on frames, and a policy that LeRobot's commands load."""

import clone_on_features as script
import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY, TRUTH_KEY
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.policies.vt_dp3.observation_encoder import PERCEIVED_KEY


@pytest.fixture
def arguments(tiny_dataset, tmp_path):
    return script.make_parser().parse_args(
        [
            f"--dataset={tiny_dataset}",
            f"--output_dir={tmp_path / 'cloned'}",
            "--steps=3",
            "--batch_size=4",
            "--passes=2",
        ]
    )


def test_the_loss_on_features_is_that_on_frames(arguments):
    policy, (preprocessor, _), dataset = script.load(arguments)
    batch = preprocessor(next(iter(torch.utils.data.DataLoader(dataset, batch_size=5))))
    features = {PERCEIVED_KEY: policy.model.encoder.perceive(batch)} | {
        key: batch[key] for key in (STATE_KEY, ACTION_KEY)
    }
    losses = []
    for seen in (batch, features):
        torch.manual_seed(0)
        losses.append(policy.forward(seen)[0])
    torch.testing.assert_close(*losses)


def test_what_the_auxiliary_loss_needs_is_kept(arguments):
    policy, (preprocessor, _), dataset = script.load(arguments)

    def with_truth(raw):
        batch = preprocessor(raw)
        return batch | {TRUTH_KEY: batch[STATE_KEY][:, -1, :2]}

    (frames,) = script.perceived(policy, with_truth, dataset, passes=1)
    torch.testing.assert_close(frames[TRUTH_KEY], frames[STATE_KEY][:, -1, :2])


def test_it_clones_and_leaves_a_policy_with_its_processors(arguments, monkeypatch, capsys):
    start, *_ = script.load(arguments)
    monkeypatch.setattr(script.CommandParser, "parse_args", lambda self: arguments)
    assert script.main() == 0
    folder = arguments.output_dir / "pretrained_model"
    assert str(folder) in capsys.readouterr().out
    cloned = VtDp3Policy.from_pretrained(folder)
    make_pre_post_processors(cloned.config, str(folder))
    before, after = start.model.state_dict(), cloned.model.state_dict()
    moved = {name for name in before if not torch.equal(before[name], after[name])}
    assert any(name.startswith("denoiser.") for name in moved)
    assert any(name.startswith("encoder.state.") for name in moved)
    assert not any(name.startswith(("encoder.points.", "encoder.pads.")) for name in moved)


def test_an_encoder_that_is_trained_is_refused(arguments):
    arguments.policy = {"freeze_encoder": False}
    with pytest.raises(ValueError, match="freeze_encoder"):
        script.load(arguments)
