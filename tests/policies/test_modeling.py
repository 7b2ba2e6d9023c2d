"""The policy: training step, moving average, acting, fine-tuned checkpoints."""

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from draccus import ParsingError
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import factory

from lerobot_vtrefine.datasets.features import (
    ACTION_KEY,
    CLOUD_KEY,
    LIMITS_KEY,
    STATE_KEY,
    TRUTH_KEY,
    dataset_features,
)
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.policies.vt_dp3 import VtDp3Config, observation_encoder
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.policies.vt_dp3.observation_encoder import PERCEIVED_KEY
from lerobot_vtrefine.sim.config import SceneConfig

Batch = dict[str, torch.Tensor]


def make_policy(limited: bool = False, truth_size: int = 0, **values: Any) -> VtDp3Policy:
    """A tiny policy with a fixed seed; `limited`: for data with limits, `truth_size`: with the truth."""
    torch.manual_seed(0)
    features = {
        key: PolicyFeature(FeatureType.STATE, tuple(feature["shape"]))
        for key, feature in dataset_features(24, 32, ALOHA, None, limited, truth_size).items()
        if key.startswith("observation")
    }
    tiny: dict[str, Any] = {"preset": "small", "point_dims": (8, 16), "down_dims": (32, 32), **values}
    action = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (16,))}
    config = VtDp3Config(device="cpu", input_features=features, output_features=action, **tiny)
    return VtDp3Policy(config).eval()


def make_batch(size: int = 3, seed: int = 0) -> Batch:
    """A processed training batch."""
    generator = torch.Generator().manual_seed(seed)
    return {
        CLOUD_KEY: torch.randn(size, 2, 20, 5, generator=generator),
        STATE_KEY: torch.rand(size, 2, 16, generator=generator) * 2 - 1,
        ACTION_KEY: torch.rand(size, 16, 16, generator=generator) * 2 - 1,
    }


def frame(batch: Batch, step: int) -> Batch:
    """One frame of a batch, as evaluation hands it over."""
    return {key: batch[key][:, step] for key in (CLOUD_KEY, STATE_KEY)}


def train(policy: VtDp3Policy, steps: int, learning_rate: float = 3e-3) -> list[float]:
    """Steps of behaviour cloning on one batch, the way LeRobot's trainer does them."""
    policy.train()
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=learning_rate)
    losses = []
    for _ in range(steps):
        loss, _ = policy(make_batch())
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
        losses.append(loss.item())
    policy.eval()
    return losses


def test_training_learns_and_the_average_that_acts_follows() -> None:
    policy = make_policy()
    before = deepcopy(policy.model.state_dict())
    losses = train(policy, 400)
    assert sum(losses[-20:]) < 0.5 * sum(losses[:20])
    batch = make_batch()
    noise = torch.randn(3, 16, 16)
    chunk = policy.sample_actions(batch, noise)
    error = (chunk - batch[ACTION_KEY]).square().mean()
    policy.model.load_state_dict(before)
    untrained = (policy.sample_actions(batch, noise) - batch[ACTION_KEY]).square().mean()
    assert error < 0.3 * untrained


def test_limits_are_seen_where_the_data_states_them_and_nowhere_else() -> None:
    plain, limited = make_policy(), make_policy(limited=True)
    batch, noise = make_batch(), torch.randn(3, 16, 16)
    low, high = ({**batch, LIMITS_KEY: torch.full((3, 2, 2), value)} for value in (-1.0, 1.0))
    assert torch.equal(plain.sample_actions(low, noise), plain.sample_actions(batch, noise))
    assert not torch.equal(limited.sample_actions(low, noise), limited.sample_actions(high, noise))
    shapes = [{name: value.shape for name, value in p.state_dict().items()} for p in (plain, limited)]
    differ = {name for name, shape in shapes[0].items() if shape != shapes[1][name]}
    assert all(name.endswith("encoder.state.0.weight") for name in differ)
    assert [shape["model.encoder.state.0.weight"][1] for shape in shapes] == [16, 18]
    with pytest.raises(ValueError, match=r"lacks observation.environment_state.*contact_force_n='\[5, 5\]'"):
        limited.sample_actions(batch, noise)
    limited.reset()
    limited.select_action({key: value[:, 0] for key, value in low.items() if key != ACTION_KEY})


def test_the_auxiliary_loss_is_learned_and_shapes_the_encoder() -> None:
    """Without a weight nothing of it is there; with one, the truth is told by what the policy sees."""
    without, given = make_policy(truth_size=2), make_policy(truth_size=2, auxiliary_weight=1.0)
    assert without.state_dict().keys() == make_policy().state_dict().keys()
    assert all(torch.equal(value, given.state_dict()[name]) for name, value in without.state_dict().items())
    batch = make_batch(32)
    cloud = batch[CLOUD_KEY]
    batch[TRUTH_KEY] = torch.stack([cloud[..., 0].amax(-1), cloud[..., 1].amax(-1)], -1) - 2.0
    optimizer = torch.optim.AdamW(given.train().get_optim_params(), lr=3e-3)
    told = []
    for _ in range(150):
        loss, parts = given(batch)
        assert loss.item() == pytest.approx(parts["noise_loss"] + parts["auxiliary_loss"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        told.append(parts["auxiliary_loss"])
    assert sum(told[-10:]) < 0.2 * sum(told[:10])
    online = given.online
    assert online is not None
    assert online.auxiliary is not None
    assert online.encoder.points is not None
    missed = online.auxiliary.loss(online.encode(batch), batch[TRUTH_KEY]).sum()
    (gradient,) = torch.autograd.grad(missed, online.encoder.points.last.weight)
    assert gradient.abs().max() > 0
    assert given(batch, reduction="none")[0].shape == (32,)
    given.eval().sample_actions(make_batch(), torch.zeros(3, 16, 16))  # which needs no truth


def test_an_auxiliary_loss_without_the_truth_is_told() -> None:
    with pytest.raises(ValueError, match=r"auxiliary_weight=0.5 needs observation.truth.*--truth=true"):
        make_policy(auxiliary_weight=0.5)
    with pytest.raises(ParsingError, match="must not be negative"):
        make_policy(truth_size=2, auxiliary_weight=-1.0)


def test_only_the_trained_network_gets_gradients() -> None:
    policy = make_policy().train()
    loss, _ = policy(make_batch())
    loss.backward()
    assert all(parameter.grad is None for parameter in policy.model.parameters())
    assert policy.online is not None
    assert all(parameter.grad is not None for parameter in policy.online.parameters())


def test_loss_per_sample_averages_to_the_loss() -> None:
    policy = make_policy(noise_draws=3).train()
    torch.manual_seed(5)
    mean, _ = policy(make_batch())
    torch.manual_seed(5)
    each, _ = policy(make_batch(), reduction="none")
    assert each.shape == (3,)
    assert torch.allclose(each.mean(), mean)


def test_every_noise_draw_counts_for_its_own_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    draws, wrong = 3, torch.tensor([0.0, 10.0, 20.0])
    policy = make_policy(noise_draws=draws).train()

    def predict(x: torch.Tensor, t: torch.Tensor, cond: torch.Tensor) -> torch.Tensor:
        return wrong.repeat_interleave(draws).view(-1, 1, 1).expand_as(x)

    monkeypatch.setattr(policy.online.denoiser, "forward", predict)
    each, _ = policy(make_batch(), reduction="none")  # noise of unit variance, so 1 + wrong**2
    assert torch.allclose(each, 1 + wrong**2, rtol=0.1, atol=0.2)


def test_select_action_samples_once_per_chunk_from_the_last_two_frames() -> None:
    policy, batch = make_policy(), make_batch()
    noise = torch.randn(3, 16, 16)
    policy.reset()
    actions = [policy.select_action(frame(batch, 0), noise=noise)]
    first = {key: value[:, [0, 0]] for key, value in batch.items() if key != ACTION_KEY}
    actions += [policy.select_action(frame(batch, 1), noise=noise) for _ in range(7)]
    assert torch.allclose(torch.stack(actions, 1), policy.sample_actions(first, noise)[:, :8], atol=1e-6)
    policy.select_action(frame(batch, 1))
    policy.reset()
    policy.select_action(frame(batch, 0), noise=noise)
    for _ in range(6):
        policy.select_action(frame(make_batch(seed=9), 0))
    policy.select_action(frame(batch, 0))
    action = policy.select_action(frame(batch, 1), noise=noise)
    assert torch.allclose(action, policy.sample_actions(batch, noise)[:, 0], atol=1e-6)


@pytest.mark.parametrize("every", [1, 2])
def test_it_decides_as_often_as_it_is_asked_to(every: int) -> None:
    """From the newest two frames each time: a chunk of one action reacts to every reading."""
    policy, noise = make_policy(n_action_steps=every), torch.randn(3, 16, 16)
    batches = [make_batch(seed=seed) for seed in range(5)]
    actions = [policy.select_action(frame(batch, 0), noise=noise) for batch in batches]
    for step, action in enumerate(actions):
        decided = step - step % every
        seen = [batches[max(decided - 1, 0)], batches[decided]]
        window = {key: torch.stack([one[key][:, 0] for one in seen], 1) for key in (CLOUD_KEY, STATE_KEY)}
        expected = policy.sample_actions(window, noise)[:, step - decided]
        assert torch.allclose(action, expected, atol=1e-6), step


def test_predict_action_chunk_takes_windows_and_frames() -> None:
    policy, batch = make_policy(), make_batch()
    noise = torch.randn(3, 16, 16)
    from_window = policy.predict_action_chunk(batch, noise=noise)
    assert from_window.shape == (3, 8, 16)
    policy.predict_action_chunk(frame(batch, 0))
    assert torch.allclose(policy.predict_action_chunk(frame(batch, 1), noise=noise), from_window, atol=1e-6)


def test_checkpoint_keeps_actions_average_and_its_age(tmp_path: Path) -> None:
    policy = make_policy()
    train(policy, 5)
    policy.save_pretrained(tmp_path)
    loaded = VtDp3Policy.from_pretrained(tmp_path, strict=True)
    for key, value in policy.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[key]), key
    assert loaded.ema is not None
    assert int(loaded.ema.step) == 5
    noise = torch.randn(3, 16, 16)
    assert torch.equal(policy.sample_actions(make_batch(), noise), loaded.sample_actions(make_batch(), noise))


@pytest.mark.parametrize(
    ("env", "told"),
    [
        ({"fps": 20}, r"--env\.fps=20, but the policy learned 10 actions a second: give --env\.fps=10"),
        ({"scene": SceneConfig(embodiment="kinova")}, r"embodiment=kinova, but the policy is of aloha"),
    ],
)
def test_lerobot_eval_refuses_an_environment_of_another_rate_or_robot(
    tmp_path: Path, env: dict[str, Any], told: str
) -> None:
    policy = make_policy(modalities="visual", fps=10)
    policy.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    own = VtRefineEnvConfig(start="grasped")
    acting = factory.make_policy(config, env_cfg=own)
    acting.save_pretrained(tmp_path)
    again = PreTrainedConfig.from_pretrained(tmp_path)
    assert (again.output_features, again.fps) == (policy.config.output_features, 10)
    with pytest.raises(ValueError, match=told):
        factory.make_policy(config, env_cfg=replace(own, **env))
    config.input_features[STATE_KEY] = PolicyFeature(FeatureType.STATE, (14,))
    with pytest.raises(ValueError, match="learned from 14 joints, and the environment's robot, aloha, has"):
        factory.make_policy(config, env_cfg=own)


def test_tuned_steps_act_as_stochastically_as_asked() -> None:
    noise, batch = torch.randn(3, 16, 16), make_batch()
    for eta in (0.0, 1.0):
        policy = make_policy()
        policy.prepare_finetuning("tail", 4, 3, 4, eta=eta)
        first, second = (policy.sample_actions(batch, noise) for _ in range(2))
        assert torch.equal(first, second) is (eta == 0.0)


@pytest.mark.parametrize("freeze_encoder", [False, True])
def test_fine_tuning_tunes_the_last_steps_and_keeps_the_base(tmp_path: Path, freeze_encoder: bool) -> None:
    policy = make_policy()
    train(policy, 5)
    noise, batch = torch.randn(3, 16, 16), make_batch()
    policy.prepare_finetuning("tail", 4, 3, 4, eta=0.0, freeze_encoder=freeze_encoder)
    assert policy.online is None
    assert policy.base is not None
    assert len(policy.process.timesteps) == 7
    before = policy.sample_actions(batch, noise)
    trained = [parameter for parameter in policy.model.parameters() if parameter.requires_grad]
    assert len(trained) == len(list((policy.model.denoiser if freeze_encoder else policy.model).parameters()))
    with torch.no_grad():
        for parameter in trained:
            parameter += 0.05
    after = policy.sample_actions(batch, noise)
    assert not torch.allclose(before, after)
    policy.save_pretrained(tmp_path)
    loaded = VtDp3Policy.from_pretrained(tmp_path)
    assert torch.equal(after, loaded.sample_actions(batch, noise))
    assert loaded.base is not None
    assert (loaded.base.encoder is loaded.model.encoder) is freeze_encoder
    assert not any(parameter.requires_grad for parameter in loaded.base.denoiser.parameters())
    with pytest.raises(ValueError, match="fine-tuned already"):
        loaded.prepare_finetuning("tail", 4, 3, 4, eta=0.0)
    with pytest.raises(ValueError, match="use the pre-trained checkpoint"):
        loaded(batch)


@pytest.mark.parametrize(
    ("steps", "words"), [(0, "is not a fine-tuned policy"), (4, "is a fine-tuned policy")]
)
def test_tuned_steps_that_the_weights_do_not_hold_are_refused(tmp_path: Path, steps: int, words: str) -> None:
    """Else an untrained base would do the first half of the denoising, or the tuned network all of it."""
    policy = make_policy()
    if steps:
        policy.prepare_finetuning("tail", 4, 3, steps, eta=0.0)
    policy.save_pretrained(tmp_path)
    path = tmp_path / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"ft_denoising_steps": 4 - steps}))
    with pytest.raises(ValueError, match=words + ".*leave out --policy.ft_denoising_steps"):
        VtDp3Policy.from_pretrained(tmp_path)


def test_paper_preset_trains_and_acts() -> None:
    policy = make_policy(preset="paper", point_dims=(8, 16), down_dims=(16, 32, 64))
    loss, _ = policy.train()(make_batch())
    loss.backward()
    assert torch.isfinite(loss)
    assert policy.predict_action_chunk(make_batch()).shape == (3, 8, 16)


def test_other_checkpoints_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"type": "act", "device": "cpu"}))
    with pytest.raises(ValueError, match="type 'act', expected 'vt_dp3'"):
        VtDp3Policy.from_pretrained(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="pretrained_model folder"):
        VtDp3Policy.from_pretrained(tmp_path / "empty")


def test_feature_noise_blurs_what_cloning_sees_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, batch = make_policy(feature_noise=0.5), make_batch(256)
    model = policy.online
    assert model is not None
    clear = model.encoder.perceive(batch)
    seen: list[Batch] = []
    encode = model.encode
    monkeypatch.setattr(model, "encode", lambda known: seen.append(known) or encode(known))
    policy.eval()(batch)
    policy.train()(batch)
    policy.train()(batch | {PERCEIVED_KEY: clear})
    assert PERCEIVED_KEY not in seen[0]
    for known in seen[1:]:
        noise = known[PERCEIVED_KEY] - clear
        torch.testing.assert_close(noise[:, 0], noise[:, 1], rtol=1e-3, atol=1e-5)
        ratio = noise[:, 0].std(0) / clear.flatten(0, 1).std(0).clamp(min=1e-9)
        assert ratio[clear.flatten(0, 1).std(0) > 1e-3].mean().item() == pytest.approx(0.5, rel=0.05)
    alone = make_policy(feature_noise=0.5, n_obs_steps=1).train()
    one = {key: value[:, :1] if key != ACTION_KEY else value for key, value in make_batch(1).items()}
    assert alone(one)[0].isfinite()  # an epoch's last batch may be a single frame, without any spread
    with pytest.raises(ParsingError, match=r"policy\.feature_noise must not be negative"):
        make_policy(feature_noise=-1.0)


def test_many_frames_are_seen_a_few_at_a_time_where_no_gradient_is_needed(monkeypatch) -> None:
    policy, batch = make_policy(), make_batch(5)
    model = policy.online
    assert model is not None
    assert model.encoder.points is not None
    whole = model.encoder.perceive(batch)
    sizes: list[int] = []
    model.encoder.points.register_forward_pre_hook(lambda _, inputs: sizes.append(len(inputs[0])))
    monkeypatch.setattr(observation_encoder, "FRAMES_AT_ONCE", 4)
    with torch.no_grad():
        torch.testing.assert_close(model.encoder.perceive(batch), whole)
    assert sizes == [4, 4, 2]
    model.encoder.perceive(batch)
    assert sizes[3:] == [10]
