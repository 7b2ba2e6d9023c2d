"""Regression of what insertion needs to know from what sensors show, by the policy's encoder or a larger one.

Shapes: ``B`` samples, ``To`` frames of history, ``K`` quantities, ``E`` episodes, ``T`` frames of an episode.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from lerobot_vtrefine.datasets.features import CLOUD_KEY, GRIDS_KEY, STATE_KEY, SURFACE_KEY
from lerobot_vtrefine.information import contact
from lerobot_vtrefine.information.frames import Frames, View, Views
from lerobot_vtrefine.information.scale import HeldScale
from lerobot_vtrefine.information.strong import StrongEncoder, SurfaceStep
from lerobot_vtrefine.observation import VisuoTactileConfig
from lerobot_vtrefine.policies.vt_dp3 import VisuoTactileProcessorStep, VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.observation_encoder import ObservationEncoder, make_encoder

HEAD_WIDTH = 256
LEARNING_RATE = 1e-3
WEIGHT_DECAY = 1e-3
JUDGED_FRAMES = 4096
"""Estimated at once when a regressor is judged."""
POLICY, STRONG = NETWORKS = ("policy", "strong")
"""The policy's own encoder, and a larger network that says how much that one loses."""


@dataclass(frozen=True)
class Senses:
    """Which sensors a regressor has, and how they enter."""

    name: str
    modalities: str
    """As of ``--policy.modalities``; empty for joint positions alone."""
    fusion: str = "pads"
    network: str = POLICY
    """One of ``NETWORKS``."""

    @property
    def words(self) -> str:
        """Name, with the network where it is not the policy's."""
        return self.name if self.network == POLICY else f"{self.name} {self.network}"

    @property
    def sees_surface(self) -> bool:
        """Whether the whole depth image is read."""
        return self.network == STRONG and self.modalities in ("visual", "visuo_tactile")

    def policy(self, body: str, preset: str, device: str, history: int) -> VtDp3Config:
        """Settings of the policy whose encoder this is, for the robot of this name."""
        return VtDp3Config(
            preset=preset,
            modalities=self.modalities or "visual",
            fusion=self.fusion,
            n_obs_steps=history,
            observation=VisuoTactileConfig(embodiment=body),
            device=device,
        )


SENSES = {
    senses.name: senses
    for senses in (
        Senses("joints", ""),
        Senses("visual", "visual"),
        Senses("tactile", "tactile"),
        Senses("visuo_tactile", "visuo_tactile"),
        Senses("visuo_tactile_cloud", "visuo_tactile", "cloud"),
    )
}
"""Every set of sensors that can be asked for."""


def asked(names: Sequence[str], networks: Sequence[str]) -> list[Senses]:
    """The sets of these names with each of the networks; joints and the paper's cloud have no larger one."""
    chosen = [SENSES[name] for name in names]
    larger = [replace(item, network=STRONG) for item in chosen if item.modalities and item.fusion == "pads"]
    return [*(chosen if POLICY in networks else []), *(larger if STRONG in networks else [])]


def views_of(chosen: list[Senses], body: str, preset: str, device: str) -> Views:
    """The preprocessing that regressors need: one view for every different cloud, and one with images; for
    larger networks one with the whole depth image.
    """
    views: dict[str, View] = {}
    for senses in chosen:
        config = senses.policy(body, preset, device, 1)
        if not senses.modalities:
            continue
        if senses.sees_surface:
            views["surface"] = SurfaceStep(config.observation)
        elif config.cloud_modalities:
            views[config.cloud_modalities] = VisuoTactileProcessorStep(
                config.observation, config.cloud_modalities
            )
        if config.sees_grids:
            views["grids"] = VisuoTactileProcessorStep(config.observation, "", grids=True)
    return views


class Estimator(nn.Module):
    """Encoder and head: history of processed frames -> ``NAMES`` (B, K) in SI units."""

    state_mean: Tensor
    state_std: Tensor

    def __init__(
        self, senses: Senses, frames: Frames, body: str, preset: str, device: str, history: int
    ) -> None:
        super().__init__()
        config = senses.policy(body, preset, device, history)
        self.body = body
        self.sources = {
            key: f"{view}/{key}"
            for view, key in (
                (config.cloud_modalities, CLOUD_KEY),
                ("grids", GRIDS_KEY),
                ("surface", SURFACE_KEY),
            )
        }
        state = frames.columns["state"]
        if senses.network == STRONG:
            self.encoder: ObservationEncoder | StrongEncoder = _strong(senses, frames, history)
        elif senses.modalities:
            self.encoder = make_encoder(config, state.shape[-1])
        else:
            self.encoder = ObservationEncoder(None, None, state.shape[-1], history)
        episode, frame = frames.index()
        seen = state[episode, frame]
        self.register_buffer("state_mean", seen.mean(0))
        self.register_buffer("state_std", seen.std(0).clamp(min=1e-6))
        self.scale = HeldScale(frames.truth[frames.held_index()], frames.truth[episode, frame])
        self.head = nn.Sequential(
            nn.Linear(self.encoder.cond_dim, HEAD_WIDTH),
            nn.ReLU(),
            nn.Linear(HEAD_WIDTH, HEAD_WIDTH),
            nn.ReLU(),
            nn.Linear(HEAD_WIDTH, frames.truth.shape[-1]),
        )
        self.history = history
        # Contacts are read off the policy's encoder without shaping it: policies start from this one.
        self.shaped_by_contact = senses.network == STRONG
        self.contact = contact.ContactHead(self.encoder.cond_dim, HEAD_WIDTH, frames.contact[episode, frame])

    def features(self, window: dict[str, Tensor]) -> Tensor:
        """What the encoder makes of columns (B, To, ...)."""
        batch = {key: window[self.sources[key]] for key in self.encoder.keys if key != STATE_KEY}
        batch[STATE_KEY] = (window["state"] - self.state_mean) / self.state_std
        return self.encoder(batch)

    def forward(self, window: dict[str, Tensor]) -> Tensor:
        """Estimates (B, K) in SI units."""
        return self.scale.expand(self.head(self.features(window)))

    def loss(self, window: dict[str, Tensor], truth: Tensor, touch: Tensor) -> Tensor:
        """Squares [standard deviations] of quantities (B, K), and what contacts (B, 4) add."""
        features = self.features(window)
        read = features if self.shaped_by_contact else features.detach()
        missed = (self.head(features) - self.scale.compress(truth)).square().mean()
        return missed + self.contact.loss(read, touch)

    def window(self, frames: Frames, episode: Tensor, frame: Tensor) -> dict[str, Tensor]:
        """The last To frames (B, To, ...) up to ``frame`` (B,); the first one fills the window."""
        back = torch.arange(1 - self.history, 1, device=frame.device)
        rows = (frame[:, None] + back).clamp(min=0)
        wanted = {"state", *(self.sources[key] for key in self.encoder.keys if key != STATE_KEY)}
        return {key: frames.columns[key][episode[:, None], rows] for key in wanted}


def _strong(senses: Senses, frames: Frames, history: int) -> StrongEncoder:
    """The larger network for these senses, as large as the frames' images are."""
    columns = frames.columns
    surface = pads = None
    if senses.sees_surface:
        height, width = columns[f"surface/{SURFACE_KEY}"].shape[-2:]
        surface = height, width
    if senses.modalities != "visual":
        count, rows, cols = columns[f"grids/{GRIDS_KEY}"].shape[-3:]
        pads = count, rows, cols
    return StrongEncoder(surface, pads, columns["state"].shape[-1], history)


def train_estimator(
    estimator: Estimator,
    frames: Frames,
    steps: int,
    batch_size: int,
    seed: int,
    told: Callable[[int], None] = lambda _: None,
) -> None:
    """Minimise ``Estimator.loss``: AdamW with a cosine schedule over ``steps``."""
    device = frames.truth.device
    generator = torch.Generator(device).manual_seed(seed)
    episode, frame = frames.index()
    optimizer = torch.optim.AdamW(estimator.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1.0, (step + 1) / 100) * 0.5 * (1 + math.cos(math.pi * step / steps))
    )
    estimator.train()
    for _ in range(steps):
        rows = torch.randint(len(episode), (batch_size,), generator=generator, device=device)
        window = estimator.window(frames, episode[rows], frame[rows])
        at = episode[rows], frame[rows]
        loss = estimator.loss(window, frames.truth[at], frames.contact[at])
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
        told(1)
    estimator.eval()


@torch.no_grad()
def episode_errors(estimator: Estimator, frames: Frames) -> Tensor:
    """Mean squared error per episode and quantity (E, K), in SI units squared, over frames with both parts in
    hand, of the episodes that have one.
    """
    episode, frame = frames.held_index()
    sums = torch.zeros_like(frames.truth[:, 0])
    for rows in torch.arange(len(episode), device=episode.device).split(JUDGED_FRAMES):
        error = estimator(estimator.window(frames, episode[rows], frame[rows]))
        error = error - frames.truth[episode[rows], frame[rows]]
        sums.index_add_(0, episode[rows], error.square())
    counts = frames.held.sum(1)
    return sums[counts > 0] / counts[counts > 0, None]


@torch.no_grad()
def contact_known(estimator: Estimator, frames: Frames, seed: int) -> contact.Known:
    """What the regressor tells of contacts in held-out frames with both parts in hand."""
    episode, frame = frames.held_index()
    sums: dict[str, tuple[Tensor, Tensor]] = {}
    for rows in torch.arange(len(episode), device=episode.device).split(JUDGED_FRAMES):
        at = episode[rows], frame[rows]
        found = estimator.contact(estimator.features(estimator.window(frames, *at)))
        for name, (score, counts) in contact.scores(estimator.contact, found, frames.contact[at]).items():
            total, count = sums.setdefault(name, tuple(frames.truth.new_zeros(2, len(frames.length))))
            total.index_add_(0, at[0], score * counts)
            count.index_add_(0, at[0], counts.to(count))
    return contact.summarise(sums, frames.contact[episode, frame], seed)


def rms_with_interval(squares: Tensor, seed: int = 0) -> Tensor:
    """RMS error and the ends of its 95 % interval (3, K), by a bootstrap over episodes (E, K)."""
    generator = torch.Generator().manual_seed(seed)
    squares = squares.cpu()
    rows = torch.randint(len(squares), (contact.RESAMPLES, len(squares)), generator=generator)
    drawn = torch.stack([squares[row].mean(0) for row in rows])
    ends = drawn.quantile(torch.tensor([0.025, 0.975]), dim=0)
    return torch.cat([squares.mean(0, keepdim=True), ends]).sqrt()
