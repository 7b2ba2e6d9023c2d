"""Small problems for DPPO: a network, behaviour cloning, and a blind peg (the paper's task in miniature)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lerobot_vtrefine.envs.decisions import Decision
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.protocols import Agent, Observation
from lerobot_vtrefine.policies.vt_dp3.diffusion import DiffusionProcess, step_grid


class ToyDenoiser(nn.Module):
    """MLP over the flat chunk, a sinusoidal time embedding and the condition."""

    def __init__(self, horizon: int, action_dim: int, cond_dim: int, width: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(horizon * action_dim + 16 + cond_dim, width),
            nn.Mish(),
            nn.Linear(width, width),
            nn.Mish(),
            nn.Linear(width, horizon * action_dim),
        )

    def forward(self, x: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        frequencies = torch.exp(torch.linspace(0, -6, 8, dtype=x.dtype))
        angles = t.unsqueeze(1).to(x.dtype) * frequencies
        cond = cond.repeat_interleave(len(x) // max(len(cond), 1), dim=0)
        features = torch.cat([x.flatten(1), angles.sin(), angles.cos(), cond], dim=1)
        return self.net(features).view_as(x)


class ToyActor(nn.Module):
    def __init__(self, obs_dim: int, horizon: int, action_dim: int, width: int = 128) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(obs_dim, 32), nn.Mish())
        self.denoiser = ToyDenoiser(horizon, action_dim, 32, width)
        self.calls = 0

    def encode(self, obs: Observation) -> Tensor:
        self.calls += 1
        return self.encoder(obs["state"])


def make_agent(
    actor: ToyActor, cfg: DppoConfig, action_shape: tuple[int, int], num_train_steps: int = 100
) -> Agent:
    grid = step_grid(cfg.sampler, num_train_steps, cfg.sampler_steps, cfg.prefix_steps)
    base = ToyActor(actor.encoder[0].in_features, *action_shape, actor.denoiser.net[0].out_features)
    base.load_state_dict(actor.state_dict())
    process = DiffusionProcess(num_train_steps, grid)
    frozen = cfg.encoder == "frozen"
    if frozen:
        base.encoder = actor.encoder
    base.requires_grad_(False).eval()
    executed = slice(0, action_shape[0])
    tuned = cfg.ft_denoising_steps
    return Agent(actor, base, process, tuned, action_shape, executed, frozen, cfg.deploy_eta)


def clone_behaviour(
    actor: ToyActor, states: Tensor, chunks: Tensor, steps: int, seed: int, num_train_steps: int = 100
) -> None:
    """Train the actor to predict noise on states (N, S) and chunks (N, H, D)."""
    generator = torch.Generator().manual_seed(seed)
    process = DiffusionProcess(num_train_steps, (0,))
    optimizer = torch.optim.AdamW(actor.parameters(), lr=1e-3, weight_decay=1e-6)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        index = torch.randint(len(states), (256,), generator=generator)
        clean, noise = chunks[index], torch.randn(chunks[index].shape, generator=generator)
        t = torch.randint(num_train_steps, (256,), generator=generator)
        eps = actor.denoiser(process.add_noise(clean, noise, t), t, actor.encode({"state": states[index]}))
        loss = (eps - noise).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


class BlindPeg:
    """A peg over a slot whose position is only estimated; the rim can be felt, its side tells where to go.

    The peg starts above the estimate. Inside the slot it descends to the goal; outside it rests on the rim,
    and the contact channel then tells on which side of the slot it is (``feel``), or nothing.
    """

    HALF_SLOT, ESTIMATE_STD, DEPTH = 0.03, 0.06, 0.1
    privileged_dim = 4
    CHUNK, ACTION_DIM, STEP_X, STEP_Z = 4, 2, 0.012, 0.05

    def __init__(self, num_envs: int, *, feel: bool, max_decisions: int = 12) -> None:
        self.num_envs, self.feel, self.max_decisions = num_envs, feel, max_decisions

    def reset(self, seeds: Sequence[int]) -> tuple[Observation, Tensor]:
        draws = torch.stack([torch.randn(3, generator=torch.Generator().manual_seed(seed)) for seed in seeds])
        self.slot = 0.2 * draws[:, 0]
        self.estimate = self.slot + self.ESTIMATE_STD * draws[:, 1]
        self.x = self.estimate + 0.03 * draws[:, 2]
        self.z = torch.full((self.num_envs,), 0.15)
        self.contact = torch.zeros(self.num_envs)
        self.decision = torch.zeros(self.num_envs)
        self.done = torch.zeros(self.num_envs, dtype=torch.bool)
        return self.observe()

    def observe(self) -> tuple[Observation, Tensor]:
        felt = self.contact if self.feel else torch.zeros_like(self.contact)
        offset, time = 10 * (self.x - self.estimate), self.decision / self.max_decisions
        state = torch.stack([offset, 5 * self.z, felt], dim=1)
        privileged = torch.stack([self.x - self.slot, self.estimate - self.slot, self.z, time], dim=1)
        return {"state": state}, privileged

    def step_chunk(self, actions: Tensor) -> Decision:
        reached = torch.zeros(self.num_envs, dtype=torch.bool)
        for action in actions.clamp(-1, 1).unbind(1):
            moving = ~self.done & ~reached
            inside = (self.x - self.slot).abs() < self.HALF_SLOT
            x = self.x + self.STEP_X * action[:, 0]
            walls = self.slot.unsqueeze(1) + torch.tensor([-self.HALF_SLOT, self.HALF_SLOT])
            x = torch.where(self.z < 0, x.clamp(walls[:, 0], walls[:, 1]), x)
            z = self.z + self.STEP_Z * action[:, 1]
            blocked = (z < 0) & ~inside
            self.x, self.z = (
                torch.where(moving, x, self.x),
                torch.where(moving, torch.where(blocked, 0.0, z), self.z),
            )
            self.contact = torch.where(moving, blocked * (self.slot - self.x).sign(), self.contact)
            reached |= moving & (self.z < -self.DEPTH)
        self.decision = self.decision + (~self.done)
        truncated = (self.decision >= self.max_decisions) & ~reached
        self.done = self.done | reached | truncated
        obs, privileged = self.observe()
        return Decision(obs, privileged, reached.float(), reached, truncated, {"success": reached})


def blind_peg_demonstrations(num_envs: int, seed: int) -> tuple[Tensor, Tensor]:
    """Straight descents towards the estimate that happened to succeed: states (N, 3), chunks (N, 4, 2).

    They contain no search, like the paper's demonstrations; the rim is felt only by accident.
    """
    env = BlindPeg(num_envs, feel=True)
    generator = torch.Generator().manual_seed(seed)
    obs, _ = env.reset(range(seed, seed + num_envs))
    target = env.estimate + 0.02 * torch.randn(num_envs, generator=generator)
    pairs, reward = [], torch.zeros(num_envs)
    for _ in range(env.max_decisions):
        running = ~env.done
        along = (target - env.x) / (env.CHUNK * env.STEP_X)
        noise = 0.15 * torch.randn(num_envs, env.CHUNK, 2, generator=generator)
        chunk = torch.stack([along, torch.full_like(along, -0.5)], dim=1).unsqueeze(1) + noise
        chunk = chunk.clamp(-1, 1)
        pairs.append((obs["state"], chunk, running))
        obs, _, step_reward, *_ = env.step_chunk(chunk)
        reward += step_reward * running
    states, chunks, running = (torch.stack(part) for part in zip(*pairs, strict=True))
    kept = running & (reward > 0)
    return states[kept], chunks[kept]
