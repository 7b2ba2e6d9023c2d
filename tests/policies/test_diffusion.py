import math

import numpy as np
import pytest
import torch

from lerobot_vtrefine.policies.vt_dp3.diffusion import (
    DiffusionProcess,
    correlated_noise,
    denoise_prefix,
    deploy,
    sample_chain,
    slice_log_prob,
    squaredcos_alpha_bar,
    step_grid,
)

GRIDS = {
    "ddpm": step_grid("ddpm", 100, 100),
    "ddim": step_grid("ddim", 100, 5),
    "tail": step_grid("tail", 100, 10, 5),
}


def numpy_alpha_bar(steps: int) -> np.ndarray:
    """The squared-cosine schedule, written again."""

    def share(t: float) -> float:
        return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [min(1 - share((i + 1) / steps) / share(i / steps), 0.999) for i in range(steps)]
    return np.cumprod(1 - np.array(betas))


def oracle(process: DiffusionProcess, clean: torch.Tensor):
    """Predicts exactly the noise that separates x from ``clean``."""
    alpha_bar = squaredcos_alpha_bar(process.num_train_steps)

    def predict(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        share = alpha_bar[t].view(-1, 1, 1).to(x)
        return (x - share.sqrt() * clean) / (1 - share).sqrt()

    return predict


def watched_oracle(process: DiffusionProcess, clean: torch.Tensor):
    """The same, and the list of what it is asked about."""
    entered: list[torch.Tensor] = []

    def predict(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        entered.append(x)
        return oracle(process, clean)(x, t)

    return predict, entered


def test_schedule_is_squared_cosine():
    alpha_bar = squaredcos_alpha_bar(100)
    np.testing.assert_allclose(alpha_bar.numpy(), numpy_alpha_bar(100), rtol=1e-12)
    assert alpha_bar[0] > 0.999
    assert alpha_bar[-1] < 1e-3


def test_grids():
    assert GRIDS["ddpm"] == tuple(range(99, -1, -1))
    assert GRIDS["ddim"] == (80, 60, 40, 20, 0)
    assert GRIDS["tail"] == (99, 81, 63, 45, 27, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0)
    assert step_grid("tail", 20, 4, 0) == (3, 2, 1, 0)
    assert step_grid("ddim", 100, 1) == (0,)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("karras", 100, 10), "ddpm, ddim, tail"),
        (("ddim", 100, 0), "1..100"),
        (("tail", 100, 10, 91), "0..90"),
    ],
)
def test_bad_grids_say_what_is_possible(arguments, words):
    with pytest.raises(ValueError, match=words):
        step_grid(*arguments)


def test_full_stochasticity_on_the_full_grid_is_ddpm():
    """eta=1 reproduces the two-coefficient DDPM posterior, computed independently in NumPy."""
    process = DiffusionProcess(100, GRIDS["ddpm"])
    rng = np.random.default_rng(0)
    x, eps = rng.normal(size=(2, 100, 4, 3))
    mean, std = process.posterior(torch.tensor(x), torch.tensor(eps), torch.arange(100), eta=1.0)
    alpha_bar = numpy_alpha_bar(100)
    for position, t in enumerate(range(99, -1, -1)):
        before = alpha_bar[t - 1] if t else 1.0
        beta = 1 - alpha_bar[t] / before
        clean = np.clip(
            (x[position] - np.sqrt(1 - alpha_bar[t]) * eps[position]) / np.sqrt(alpha_bar[t]), -1, 1
        )
        on_clean = beta * np.sqrt(before) / (1 - alpha_bar[t])
        on_x = (1 - before) * np.sqrt(1 - beta) / (1 - alpha_bar[t])
        np.testing.assert_allclose(mean[position], on_clean * clean + on_x * x[position], atol=1e-9)
        expected = np.sqrt(beta * (1 - before) / (1 - alpha_bar[t]))
        np.testing.assert_allclose(std[position].item(), expected, atol=1e-9)


def test_ddim_standard_deviations():
    process = DiffusionProcess(100, GRIDS["ddim"])
    x = torch.zeros(5, 1, 1, dtype=torch.float64)
    _, std = process.posterior(x, x, torch.arange(5), eta=1.0)
    np.testing.assert_allclose(std.flatten(), [0.738, 0.514, 0.295, 0.025, 0.0], atol=5e-4)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_perfect_denoiser_recovers_the_action(grid):
    process = DiffusionProcess(100, GRIDS[grid])
    clean = torch.rand(6, 4, 3, dtype=torch.float64) * 2 - 1
    result = deploy(process, oracle(process, clean), torch.randn_like(clean))
    torch.testing.assert_close(result, clean, atol=1e-9, rtol=0)


def test_deployment_is_deterministic_and_uses_the_base_first():
    process = DiffusionProcess(100, GRIDS["tail"])
    seen: dict[str, list[int]] = {"base": [], "tuned": []}

    def recording(name):
        def predict(x, t):
            seen[name].append(int(t[0]))
            return x

        return predict

    noise = torch.randn(2, 4, 3)
    first = deploy(process, recording("tuned"), noise, num_tuned=10, predict_noise_base=recording("base"))
    assert seen == {"base": [99, 81, 63, 45, 27], "tuned": list(range(9, -1, -1))}
    again = deploy(process, recording("tuned"), noise, num_tuned=10, predict_noise_base=recording("base"))
    assert torch.equal(first, again)
    assert first.abs().max() <= 1


def test_deployment_of_a_tuned_chain_keeps_the_posterior_noise_but_in_the_last_step():
    """Each tuned latent is mean + eta * sigma * noise; nothing is random before and after them."""
    process = DiffusionProcess(100, GRIDS["tail"])
    clean = torch.zeros(4000, 1, 1)
    predict, entered = watched_oracle(process, clean)
    start = torch.randn_like(clean)
    result = deploy(
        process, predict, start, num_tuned=10, eta=1.0, generator=torch.Generator().manual_seed(3)
    )
    latents = [*entered[5:], result]
    assert torch.equal(latents[0], denoise_prefix(process, oracle(process, clean), start, num_tuned=10))
    for step in range(10):
        mean, std = process.step(oracle(process, clean), latents[step], 5 + step, eta=1.0)
        shift = latents[step + 1] - mean
        assert abs(shift.std() - std[0]) < 0.05 * std[0] + 1e-9
        assert shift.abs().max() <= 3 * std[0] + 1e-6
    assert torch.equal(result, mean)
    state = torch.random.get_rng_state()
    again = deploy(process, predict, start, num_tuned=10, eta=1.0, generator=torch.Generator().manual_seed(3))
    assert torch.equal(result, again)
    assert torch.equal(torch.random.get_rng_state(), state)


def test_deployed_noise_may_be_smooth_over_a_chunks_actions():
    process = DiffusionProcess(100, GRIDS["ddim"])
    clean = torch.zeros(4000, 2, 1)
    predict, entered = watched_oracle(process, clean)
    noise = torch.Generator().manual_seed(5)
    deploy(process, predict, torch.randn_like(clean), num_tuned=3, eta=1.0, correlation=0.8, generator=noise)
    for step in (2, 3):
        mean, std = process.step(oracle(process, clean), entered[step], step, eta=1.0)
        shift = (entered[step + 1] - mean)[..., 0]
        np.testing.assert_allclose(shift.std(dim=0), float(std.flatten()[0]), rtol=0.05)
        assert abs(float(torch.corrcoef(shift.T)[0, 1]) - 0.8) < 0.03


def test_chain_noise_is_floored_and_clipped():
    """With a perfect denoiser each latent is mean + max(sigma, floor) * noise, |noise| <= 3."""
    process = DiffusionProcess(100, GRIDS["tail"])
    clean = torch.zeros(4000, 1, 1)
    predict = oracle(process, clean)
    start = denoise_prefix(process, predict, torch.randn_like(clean), num_tuned=10)
    chain = sample_chain(
        process,
        predict,
        start,
        num_tuned=10,
        executed=slice(0, 1),
        eta=1.0,
        min_sampling_std=0.05,
        min_log_prob_std=0.1,
        generator=torch.Generator().manual_seed(0),
    )
    assert chain.latents.shape == (4000, 11, 1, 1)
    assert chain.log_probs.shape == (4000, 10)
    assert torch.equal(chain.latents[:, 0], start)
    for step in range(10):
        x = chain.latents[:, step]
        mean, std = process.step(predict, x, 5 + step, eta=1.0)
        noise = (chain.latents[:, step + 1] - mean) / std.clamp(min=0.05)
        assert noise.abs().max() <= 3 + 1e-4
        assert abs(noise.std() - 1) < 0.05
        density = torch.distributions.Normal(mean, std.clamp(min=0.1)).log_prob(chain.latents[:, step + 1])
        torch.testing.assert_close(chain.log_probs[:, step], density.clamp(-5, 2).flatten())


def test_noise_of_all_steps_is_drawn_as_one_step_after_another_would():
    process, correlation = DiffusionProcess(100, GRIDS["tail"]), 0.8
    predict = oracle(process, torch.zeros(5, 8, 2))
    latent = torch.randn(5, 8, 2)
    floors = {"min_sampling_std": 0.03, "min_log_prob_std": 0.06}
    generators = [torch.Generator().manual_seed(3) for _ in range(2)]
    chain = sample_chain(
        process,
        predict,
        latent,
        num_tuned=10,
        executed=slice(0, 4),
        eta=1.0,
        correlation=correlation,
        generator=generators[0],
        **floors,
    )
    for step in range(10):
        mean, std = process.step(predict, latent, 5 + step, 1.0)
        white = torch.randn(mean.shape, generator=generators[1]).clamp(-3, 3)
        latent = mean + std.clamp(min=0.03) * correlated_noise(white, correlation)
        log_prob = slice_log_prob(latent, mean, std.clamp(min=0.06), slice(0, 4), correlation)
        assert torch.equal(chain.means[:, step], mean)
        assert torch.equal(chain.latents[:, step + 1], latent)
        assert torch.equal(chain.log_probs[:, step], log_prob)


def test_log_prob_against_numpy_and_its_clamp():
    rng = np.random.default_rng(1)
    latent, mean = rng.normal(size=(2, 3, 5, 2))
    std = np.full((3, 1, 1), 0.7)
    mean[0, 0, 0] = latent[0, 0, 0] + 20 * 0.7  # density below the clamp
    result = slice_log_prob(*(torch.tensor(a) for a in (latent, mean, std)), slice(0, 4))
    density = -0.5 * ((latent - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(result, np.clip(density[:, :4], -5, 2).mean((1, 2)), rtol=1e-12)


def test_gradient_reaches_only_the_executed_slice():
    mean = torch.randn(2, 8, 3, requires_grad=True)
    slice_log_prob(torch.zeros(2, 8, 3), mean, 3 * torch.ones(2, 1, 1), slice(1, 5)).sum().backward()
    assert (mean.grad[:, 1:5] != 0).all()
    assert (mean.grad[:, :1] == 0).all()
    assert (mean.grad[:, 5:] == 0).all()


def test_forward_process_has_unit_variance():
    process = DiffusionProcess(100, GRIDS["ddim"])
    clean = torch.randn(20_000, 1, 1)
    noisy = process.add_noise(clean, torch.randn_like(clean), torch.randint(100, (20_000,)))
    assert abs(noisy.std() - 1) < 0.03
