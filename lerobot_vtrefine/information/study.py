"""One task's study: frames, a regressor per set of senses, and the expert acting on each.

What comes out is a ``Study``; ``save`` writes it with the trained encoders.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import binomtest

from lerobot_vtrefine.datasets.features import STATE_KEY
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.information import closed_loop
from lerobot_vtrefine.information.acceptance import Verdict, judge
from lerobot_vtrefine.information.contact import SHARES
from lerobot_vtrefine.information.estimator import (
    NETWORKS,
    POLICY,
    Estimator,
    Senses,
    asked,
    contact_known,
    episode_errors,
    rms_with_interval,
    train_estimator,
    views_of,
)
from lerobot_vtrefine.information.frames import FIRST_SEED, Frames, Views, collect_frames
from lerobot_vtrefine.information.quantities import NAMES, unit_of
from lerobot_vtrefine.information.tolerance import SIZES, Tolerated, tolerance
from lerobot_vtrefine.policies.vt_dp3.observation_encoder import ObservationEncoder, save_encoder
from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS

TRAINING_SHARE = 0.85
TRUTH = "truth"

Told = Callable[[str, int, int], None]
"""(what is done, total, done now)"""


@dataclass(frozen=True)
class Effort:
    """How much is simulated and trained."""

    episodes: int = 1024
    """Episodes of frames; the last of them, three of twenty, are held out."""
    num_envs: int = 64
    """Simulations side by side."""
    steps: int = 2000
    """Training steps of each regressor."""
    batch_size: int = 256
    """Frames in a training batch."""
    history: tuple[int, ...] = (1, 10)
    """Frames that a regressor sees; encoders are saved for the first entry."""
    closed_loop_episodes: int = 256
    """Episodes of the expert per set of senses; 0: none."""
    tolerance_episodes: int = 64
    """Episodes of the expert per size of an error that it is given, for the page's curves; 0: none."""
    clearances_m: tuple[float, ...] = ()
    """More clearances to study in the same way, for the page's curves; each takes as long as the first."""
    preset: str = "small"
    """Whose encoder: ``--policy.preset``."""
    networks: tuple[str, ...] = (POLICY,)
    """policy (the policy's own encoder), strong (a larger network on whole images, to tell what the sensors
    know from what that encoder keeps of it), or both."""
    device: str = "cpu"
    """Where the regressors are trained, cpu or cuda."""
    seed: int = 0
    """Seed of the first episode, counted from those of studies, and of the training."""

    def __post_init__(self) -> None:
        for name in ("episodes", "num_envs", "steps", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"--effort.{name} must be at least 1, got {getattr(self, name)}")
        if not self.history or min(self.history) < 1:
            raise ValueError(f"--effort.history must hold numbers of frames from 1, got {self.history}")
        unknown = [name for name in self.networks if name not in NETWORKS]
        if unknown or not self.networks:
            raise ValueError(
                f"--effort.networks={','.join(self.networks)}: choose from {', '.join(NETWORKS)}"
            )
        if self.clearances_m and min(self.clearances_m) <= 0:
            raise ValueError(f"--effort.clearances_m must hold lengths above 0, got {self.clearances_m}")
        if self.episodes < 2 * self.num_envs:
            raise ValueError(
                f"--effort.episodes={self.episodes} must be at least twice --effort.num_envs={self.num_envs}"
            )
        most = closed_loop.FIRST_SEED - FIRST_SEED - self.episodes
        if not 0 <= self.seed <= most:
            raise ValueError(f"--effort.seed must be within 0..{most}, got {self.seed}")


@dataclass
class Finding:
    """What one set of senses with one length of history knows."""

    senses: str
    history: int
    rms: dict[str, tuple[float, float, float]]
    """Error on held-out episodes and its 95 % interval, in the units of ``unit_of``."""
    success: tuple[int, int] | None = None
    """Of episodes in which the expert acted on the estimates."""
    network: str = POLICY
    """One of ``NETWORKS``."""
    contact: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """As in ``contact.Known.told``."""


@dataclass
class Study:
    """All findings on one task."""

    prior: dict[str, float]
    """Standard deviation of each quantity in the held-out frames with both parts in hand: the error of one
    who sees nothing.
    """
    findings: list[Finding] = field(default_factory=list)
    true_success: tuple[int, int] | None = None
    tolerated: list[Tolerated] = field(default_factory=list)
    """The expert with errors of known sizes."""
    at_clearance: dict[float, "Study"] = field(default_factory=dict)
    """The same task with other clearances [m]."""
    contact_unseen: dict[str, float] = field(default_factory=dict)
    """As in ``contact.Known.unseen``."""

    def success_of(self, senses: str) -> float | None:
        """Best success over networks and lengths of history; None where it was not measured."""
        if senses == TRUTH:
            return None if self.true_success is None else _rate(self.true_success)
        rates = [_rate(f.success) for f in self.findings if f.senses == senses and f.success is not None]
        return max(rates) if rates else None

    @property
    def verdict(self) -> Verdict:
        """Whether this task can show that touch pays."""
        return judge(*(self.success_of(name) for name in (TRUTH, "visuo_tactile", "visual")))


def study(
    config: VtRefineEnvConfig,
    senses: Sequence[str],
    effort: Effort,
    told: Told = lambda *_: None,
    keep: Callable[[Senses, Estimator], None] = lambda *_: None,
) -> Study:
    """Collect, train, test, and let the expert act; ``keep`` gets the regressors of the first history.

    Raises:
        ValueError: other clearances of a pair of meshes, or an expert that hardly ever grasps both parts.
    """
    if effort.clearances_m and config.scene_config.pair not in PROCEDURAL_PAIRS:
        raise ValueError(f"--effort.clearances_m: {config.scene_config.pair} has the clearance of its meshes")
    chosen = asked(senses, effort.networks)
    body, device = config.body.name, torch.device(effort.device)
    views = views_of(chosen, body, effort.preset, effort.device)
    count = effort.num_envs
    first, heard = FIRST_SEED + effort.seed, lambda n: told("frames", effort.episodes, n)
    frames = collect_frames(config, effort.episodes, count, views, device, heard, first)
    training, held_out = frames.split(TRAINING_SHARE)
    if training.held.sum() < 2 or not held_out.held.any():
        raise ValueError("both parts got into the hands too seldom: raise --effort.episodes")
    result = Study(_shown(_spread(held_out)))
    if effort.closed_loop_episodes:
        done = closed_loop.expert_success(
            config, effort.closed_loop_episodes, count, None, {}, frames.grasps, device
        )
        result.true_success = (int(done.sum()), len(done))
    for history in effort.history:
        for item in chosen:
            estimator = _trained(item, training, body, effort, history, told)
            if history == effort.history[0]:
                keep(item, estimator)
            known = contact_known(estimator, held_out, effort.seed)
            result.contact_unseen = known.unseen
            result.findings.append(_tested(item, estimator, held_out, config, effort, views, known.told))
            told("senses", len(chosen) * len(effort.history), 1)
    if effort.tolerance_episodes:
        sizes = sum(map(len, SIZES.values()))
        result.tolerated = tolerance(
            config, effort.tolerance_episodes, count, lambda n: told("errors of known size", sizes, n)
        )
    for clearance_m in effort.clearances_m:
        again = replace(effort, clearances_m=(), tolerance_episodes=0)
        result.at_clearance[clearance_m] = study(
            replace(config, clearance_m=clearance_m), senses, again, told
        )
    return result


def _trained(item: Senses, frames: Frames, body: str, effort: Effort, history: int, told: Told) -> Estimator:
    with torch.random.fork_rng():  # whose caller's own numbers go on as they were
        torch.manual_seed(effort.seed)
        estimator = Estimator(item, frames, body, effort.preset, effort.device, history).to(effort.device)
    label = f"{item.words}, {history} frame{'s' * (history > 1)}"
    train_estimator(
        estimator,
        frames,
        effort.steps,
        effort.batch_size,
        effort.seed,
        lambda n: told(label, effort.steps, n),
    )
    return estimator


def _tested(
    item: Senses,
    estimator: Estimator,
    held_out: Frames,
    config: VtRefineEnvConfig,
    effort: Effort,
    views: Views,
    contact: dict[str, tuple[float, float, float]],
) -> Finding:
    ends = rms_with_interval(episode_errors(estimator, held_out), effort.seed)
    columns = [_shown(row) for row in ends.numpy()]
    finding = Finding(
        item.name,
        estimator.history,
        {name: (columns[0][name], columns[1][name], columns[2][name]) for name in NAMES},
        network=item.network,
        contact=contact,
    )
    if effort.closed_loop_episodes:
        read = [estimator.sources[key].split("/")[0] for key in estimator.encoder.keys if key != STATE_KEY]
        needed = {name: views[name] for name in read}
        done = closed_loop.expert_success(
            config,
            effort.closed_loop_episodes,
            effort.num_envs,
            estimator,
            needed,
            held_out.grasps,
            torch.device(effort.device),
        )
        finding.success = (int(done.sum()), len(done))
    return finding


def _spread(frames: Frames) -> np.ndarray:
    """Standard deviation (K,) of what is estimated, over frames with both parts in hand; every episode weighs
    the same, however long it is, as it does in the regressors' errors."""
    episode, frame = frames.held_index()
    weight = 1 / frames.held.sum(1)[episode, None]
    truth = frames.truth[episode, frame]
    mean = (weight * truth).sum(0) / weight.sum()
    return ((weight * (truth - mean).square()).sum(0) / weight.sum()).sqrt().cpu().numpy()


def _shown(values: np.ndarray) -> dict[str, float]:
    """Values (K,) in SI units, by name, in the units they are reported in."""
    return {
        name: round(float(value) * unit_of(name)[0], 4) for name, value in zip(NAMES, values, strict=True)
    }


def _rate(success: tuple[int, int]) -> float:
    return success[0] / success[1]


def as_json(found: Study, effort: Effort) -> dict[str, Any]:
    """Everything, with units and Wilson's intervals."""

    return {
        "verdict": found.verdict.reason,
        "accepted": found.verdict.accepted,
        "judged": found.verdict.short,
        **_found(found),
        "tolerance": [
            {"error": item.error, "size": item.size, "expert": _proportion(item.success)}
            for item in found.tolerated
        ],
        "at_clearance_m": {str(clearance): _found(other) for clearance, other in found.at_clearance.items()},
        "effort": asdict(effort),
    }


def _found(found: Study) -> dict[str, Any]:
    """Errors and successes at one clearance."""
    return {
        "units": {name: unit_of(name)[1] for name in NAMES},
        "prior": found.prior,
        "contact_unseen": found.contact_unseen,
        "true_state": _proportion(found.true_success),
        "findings": [
            {
                "senses": finding.senses,
                "network": finding.network,
                "history": finding.history,
                "rms": {name: {"rms": v[0], "ci95": list(v[1:])} for name, v in finding.rms.items()},
                "contact": {
                    name: {("share" if name in SHARES else "rms"): v[0], "ci95": list(v[1:])}
                    for name, v in finding.contact.items()
                },
                "expert": _proportion(finding.success),
            }
            for finding in found.findings
        ],
    }


def _proportion(success: tuple[int, int] | None) -> dict[str, Any] | None:
    """Counts with Wilson's interval."""
    if success is None:
        return None
    low, high = binomtest(*success).proportion_ci(method="wilson")
    return {"success": success[0], "episodes": success[1], "ci95": [round(low, 4), round(high, 4)]}


def save_keeper(folder: Path, effort: Effort) -> Callable[[Senses, Estimator], None]:
    """A ``keep`` that writes encoders to ``folder``, where ``--policy.pretrained_encoder`` finds them."""

    def keep(senses: Senses, estimator: Estimator) -> None:
        if senses.modalities and isinstance(estimator.encoder, ObservationEncoder):
            config = senses.policy(estimator.body, effort.preset, effort.device, 1)
            save_encoder(estimator.encoder, config, folder)

    return keep


def write(found: Study, effort: Effort, folder: Path) -> None:
    """``information.json`` in ``folder``."""
    (folder / "information.json").write_text(json.dumps(as_json(found, effort), indent=2) + "\n")
