import math
from dataclasses import dataclass, field

import draccus
import pytest

from lerobot_vtrefine.finetune.config import DppoConfig, FineDppo, PaperDppo, SmallDppo, TrustRegionDppo


@dataclass
class Holder:
    dppo: DppoConfig = field(default_factory=PaperDppo)


def test_presets_are_chosen_by_type_and_single_fields_changed():
    assert draccus.parse(Holder, args=["--dppo.epochs=3"]).dppo == PaperDppo(epochs=3)
    cfg = draccus.parse(Holder, args=["--dppo.type=small", "--dppo.epochs=3"]).dppo
    assert isinstance(cfg, SmallDppo)
    assert cfg.epochs == 3
    assert cfg.clip == SmallDppo().clip


def test_the_fine_preset_is_the_trust_region_with_less_noise_and_a_pull_to_the_imitation():
    coarse, fine = TrustRegionDppo(), FineDppo()
    changed = {key for key in vars(coarse) if vars(coarse)[key] != vars(fine)[key]}
    assert changed == {
        "iterations",
        "min_sampling_std",
        "kl_per_decision",
        "kl_per_decision_final",
        "kl_coef",
    }
    assert fine.kl_per_decision < coarse.kl_per_decision


def test_one_tuned_step_has_a_finite_clip_range():
    """The reference computes 0/0 for K'=1."""
    assert PaperDppo(ft_denoising_steps=1, clip=0.01, clip_first=0.001).clip_range(0) == 0.01


def test_clip_range_grows_exponentially_to_the_last_step():
    cfg = PaperDppo(ft_denoising_steps=5, clip=0.01, clip_first=0.001, clip_rate=3.0)
    ranges = [cfg.clip_range(step) for step in range(5)]
    assert ranges[0] == pytest.approx(0.001)
    assert ranges[-1] == pytest.approx(0.01)
    middle = 0.001 + 0.009 * (math.exp(1.5) - 1) / (math.exp(3) - 1)
    assert ranges[2] == pytest.approx(middle)
    assert PaperDppo(clip_rate=0.0).clip_range(3) == PaperDppo().clip


@pytest.mark.parametrize(
    ("sampler", "eta", "deployed"), [("tail", 1.0, 1.0), ("ddpm", 0.5, 0.5), ("ddim", 1.0, 0.0)]
)
def test_deployment_keeps_the_noise_of_the_chain_but_not_ddims(sampler, eta, deployed):
    assert SmallDppo(sampler=sampler, eta=eta).deploy_eta == deployed


def test_actor_learning_rate_waits_rises_and_decays_over_this_run():
    cfg = PaperDppo(iterations=100, critic_warmup=2, lr_warmup=10, actor_lr=1e-5, actor_lr_final=1e-6)
    rates = [cfg.actor_lr_at(iteration) for iteration in range(101)]
    assert rates[:2] == [0.0, 0.0]
    assert rates[2] == pytest.approx(1e-6)
    assert max(rates) == rates[12] == pytest.approx(1e-5)
    assert rates[100] == pytest.approx(1e-6)


def test_critics_learning_rate_decays_over_all_iterations():
    cfg = PaperDppo(iterations=100, critic_lr=1e-3, critic_lr_final=1e-4)
    rates = [cfg.critic_lr_at(iteration) for iteration in (0, 25, 50, 100)]
    half_turn = 0.5 * (1 + math.cos(math.pi / 4))
    assert rates == pytest.approx([1e-3, 1e-4 + 9e-4 * half_turn, 5.5e-4, 1e-4])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"timeout": "ignore"}, "--dppo.timeout must be one of terminal, bootstrap"),
        ({"encoder": "half"}, "--dppo.encoder must be one of trained, frozen"),
        ({"actor_lr": math.nan}, "--dppo.actor_lr must be a number, got nan"),
        ({"gae_lambda": 1.5}, r"--dppo.gae_lambda must lie in \[0, 1\], got 1.5"),
        ({"gamma": 2.0}, r"--dppo.gamma must lie in \[0, 1\], got 2.0"),
        ({"num_envs": 0}, "--dppo.num_envs must be positive"),
        ({"eta": 1.5}, r"--dppo.eta must lie in \[0, 1\]"),
        ({"min_log_prob_std": 0.05}, "--dppo.min_log_prob_std must be at least 0.055"),
        ({"max_grad_norm": -1.0}, "--dppo.max_grad_norm must not be negative"),  # it had turned gradients
        ({"decisions": -1}, "--dppo.decisions must not be negative"),
        ({"micro_batch_decisions": -1}, "--dppo.micro_batch_decisions must not be negative"),
        ({"kl_coef": -0.1}, "--dppo.kl_coef must not be negative"),
    ],
)
def test_bad_values_name_the_flag(change, words):
    with pytest.raises(ValueError, match=words):
        PaperDppo(**change)
