"""The diagnosis of a camera: depth images of episodes in, camera_extrinsics and depth_scale out.

The episode is the unit: a name must make trials that no fit has seen agree better with the twin, and all
episodes must say so together.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.camera.frames import DepthFrames, read_frames
from lerobot_vtrefine.diagnose.camera.model import CameraModel
from lerobot_vtrefine.diagnose.camera.registration import (
    EXTRINSICS,
    SCALE,
    Registration,
    Twin,
    errors,
    register,
)
from lerobot_vtrefine.diagnose.evidence import Evidence, TrialError
from lerobot_vtrefine.diagnose.joints import flips
from lerobot_vtrefine.diagnose.core.heldout import lock
from lerobot_vtrefine.diagnose.verdict import Cause, Heldout, Parameter, Status

Array = np.ndarray
Progress = Callable[[str, float], None]

ALPHA = 0.02
LEAST_GAIN = 0.01
FOLDS = 5
CANDIDATES = {"camera_extrinsics": EXTRINSICS, "depth_scale": SCALE}
_NAMES = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
_DRAWS = 1000
_PARSIMONY = 0.02


@dataclass(frozen=True)
class VisionDiagnosis:
    """What images tell about a camera, to stand beside a robot's diagnosis; errors are depths in metres."""

    status: Status
    causes: tuple[Cause, ...]
    ambiguous_with: tuple[tuple[str, ...], ...]
    heldout: Heldout | None
    minimum_detectable: Mapping[str, float]
    next_experiment: Mapping[str, Any] | None
    extended_model: CameraModel
    evidence: tuple[Evidence, ...]
    trial_errors: tuple[TrialError, ...]
    unit: str = "m"


def diagnose_vision(root: Path, seed: int = 0, progress: Progress | None = None) -> VisionDiagnosis:
    """Judge the camera of a LeRobot dataset with depth images, stated camera pose and intrinsics.

    Raises ValueError if the dataset lacks one of them.
    """
    return diagnose_frames(read_frames(root), seed, progress)


def diagnose_frames(frames: DepthFrames, seed: int = 0, progress: Progress | None = None) -> VisionDiagnosis:
    """The same for frames in memory."""
    tell = progress or (lambda text, done: None)
    episodes = np.unique(frames.episode)
    locked = episodes[lock([str(index) for index in episodes], seed)]
    search = _Search(frames.of(np.setdiff1d(episodes, locked)), seed)
    tell("camera: fitting its pose and the scale of its depths", 0.2)
    search.run()
    tell("camera: held-out episodes", 0.8)
    return search.report(frames.of(locked) if len(locked) else None)


class _Search:
    """Discovery episodes and what was found on them."""

    def __init__(self, frames: DepthFrames, seed: int) -> None:
        self.twin, self.seed = Twin(frames), seed
        self.episodes, self.place = np.unique(frames.episode, return_inverse=True)
        shuffled = np.random.default_rng(seed).permutation(len(self.episodes))
        self.fold = np.empty(len(self.episodes), dtype=int)
        self.fold[shuffled] = np.arange(len(self.episodes)) % min(FOLDS, len(self.episodes))
        self.nothing = np.zeros(7, dtype=bool)
        self.fits: dict[tuple[str, ...], tuple[Registration, Array]] = {(): self._fit(self.nothing)}
        self.found: tuple[str, ...] = ()
        self.rival: str | None = None
        self.p_values: dict[str, tuple[float, float]] = {}

    def run(self) -> None:
        """Each cause alone, then both; the simplest that does as well as the best."""
        for name, free in CANDIDATES.items():
            self.fits[name,] = self._fit(free)
        both = tuple(CANDIDATES)
        self.fits[both] = self._fit(EXTRINSICS | SCALE)
        alone, adjusted = self._compare((), [(name,) for name in CANDIDATES])
        able = []
        for place, name in enumerate(CANDIDATES):
            self.p_values[name] = (float(alone[place]), float(adjusted[place]))
            if adjusted[place] < ALPHA and self.gain((name,), ()) > LEAST_GAIN:
                able.append((name,))
        if not able:
            return
        best = min(able, key=lambda names: self.mean(names))
        # A scale is one number, a pose six: where both do as well, the scale it is.
        if ("depth_scale",) in able and self.mean(("depth_scale",)) < (1 + _PARSIMONY) * self.mean(best):
            best = ("depth_scale",)
        alone, _ = self._compare(best, [both])
        if alone[0] < ALPHA and self.gain(both, best) > LEAST_GAIN:
            self.found = both
            return
        self.found = best
        other = next((name,) for name in CANDIDATES if (name,) != best)
        leads, _ = self._compare(other, [best])
        if leads[0] > 0.1 and self.gain(other, ()) > 0.9 * self.gain(best, ()):
            self.rival = other[0]

    def mean(self, names: tuple[str, ...]) -> float:
        """Held-out mean squared error of a model."""
        return float(self.fits[names][1].mean())

    def gain(self, names: tuple[str, ...], over: tuple[str, ...]) -> float:
        """Part of another model's held-out squared error that a model takes away."""
        return 1 - self.mean(names) / max(self.mean(over), 1e-300)

    def _fit(self, free: Array) -> tuple[Registration, Array]:
        """A fit to all episodes, and every episode's error under fits without its fold."""
        fitted = register(self.twin, free)
        held_out = np.empty(len(self.episodes))
        for fold in np.unique(self.fold):
            out = self.fold == fold
            theta = fitted.reweighted((~out[self.place]).astype(float)) if free.any() else fitted.theta
            held_out[out] = self._by_episode(errors(self.twin, theta))[out]
        return fitted, held_out

    def _by_episode(self, values: Array) -> Array:
        return np.bincount(self.place, values) / np.bincount(self.place)

    def _compare(self, before: tuple[str, ...], after: list[tuple[str, ...]]) -> tuple[Array, Array]:
        base = self.fits[before][1][:, None]
        other = np.stack([self.fits[names][1] for names in after], 1)
        return flips.one_sided((base - other) / (base + other).clip(1e-300), self.seed)

    def report(self, locked: DepthFrames | None) -> VisionDiagnosis:
        """Everything that the verdict needs."""
        fitted, _ = self.fits[self.found]
        test = Twin(locked) if locked is not None else self.twin
        where = np.unique(test.frames.episode, return_inverse=True)
        before, after = (
            np.bincount(where[1], errors(test, theta)) / np.bincount(where[1])
            for theta in (np.zeros(7), fitted.theta)
        )
        files = tuple(f"episode_{index:06d}" for index in where[0])
        causes = tuple(
            Cause(name, "cause", self._params(fitted, name), self.p_values[name][1], self._loss(test, name))
            for name in self.found
        )
        rivals = ((self.found[0], self.rival),) if self.rival is not None else ()
        status: Status = "ambiguous" if rivals else "explained" if causes else "adequate"
        return VisionDiagnosis(
            status=status,
            causes=causes,
            ambiguous_with=rivals,
            heldout=_heldout(before, after, files, self.seed) if locked is not None else None,
            minimum_detectable=self._detectable(),
            next_experiment=_NEXT if rivals else None,
            extended_model=_model(fitted.theta),
            evidence=self._evidence(),
            trial_errors=tuple(
                TrialError(file, file, float(np.sqrt(a)), float(np.sqrt(b)))
                for file, a, b in zip(files, before, after, strict=True)
            ),
        )

    def _params(self, fitted: Registration, name: str) -> dict[str, Parameter]:
        draws = np.random.default_rng(self.seed).integers(0, len(self.episodes), (_DRAWS, len(self.episodes)))
        counts = np.stack([np.bincount(row, minlength=len(self.episodes)) for row in draws])
        drawn = np.stack([fitted.reweighted(weights[self.place].astype(float)) for weights in counts])
        low, high = np.percentile(drawn, [2.5, 97.5], axis=0)
        if name == "depth_scale":
            value, interval = float(np.exp(fitted.theta[6])), (float(np.exp(low[6])), float(np.exp(high[6])))
            return {"factor": Parameter(value, interval, "1")}
        return {
            key: Parameter(float(fitted.theta[k]), (float(low[k]), float(high[k])), key.rpartition("_")[2])
            for k, key in enumerate(_NAMES)
        }

    def _loss(self, test: Twin, name: str) -> float:
        rest = tuple(other for other in self.found if other != name)
        without, now = (errors(test, self.fits[names][0].theta).mean() for names in (rest, self.found))
        return float(1 - now / max(without, 1e-300))

    def _detectable(self) -> dict[str, float]:
        """Four standard errors between episodes: the largest shift [m], and the scale's deviation from 1."""
        fitted, _ = self.fits[self.found]
        total = fitted.normal.sum(0)
        score = np.stack([np.bincount(self.place, column) for column in fitted.slope.T], 1)
        out = {}
        for name, free in CANDIDATES.items():
            inverse = np.linalg.pinv(total[np.ix_(free, free)])
            centred = (score - score.mean(0))[:, free]
            error = np.sqrt(np.diag(inverse @ (centred.T @ centred) @ inverse))
            out[name] = float(4 * error[:3].max())
        return out

    def _evidence(self) -> tuple[Evidence, ...]:
        out = []
        for name in CANDIDATES:
            alone, adjusted = self.p_values[name]
            decision = "accepted" if name in self.found else "tie" if name == self.rival else "rejected"
            reason = f"agreement of the twin's depth with {len(self.episodes)} episodes' images"
            out.append(Evidence(name, alone, adjusted, self.gain((name,), ()), decision, reason))
        return tuple(out)


_NEXT = {
    "decides": list(CANDIDATES),
    "text": "Record episodes in which the arms come close to the camera and reach far from it: a scale grows "
    "with distance, a shift does not.",
    "protocol": {"distances_m": [0.3, 0.9], "episodes": 8},
}


def _model(theta: Array) -> CameraModel:
    x, y, z, rx, ry, rz = (float(value) for value in theta[:6])
    return CameraModel((x, y, z), (rx, ry, rz), float(np.exp(theta[6])))


def _heldout(before: Array, after: Array, files: tuple[str, ...], seed: int) -> Heldout:
    draws = np.random.default_rng(seed).integers(0, len(before), (_DRAWS, len(before)))
    low, high = np.percentile(1 - after[draws].sum(1) / before[draws].sum(1), [2.5, 97.5])
    gain = float(1 - after.mean() / before.mean())
    base, extended = float(np.sqrt(before.mean())), float(np.sqrt(after.mean()))
    return Heldout("rmse of depth [m]", base, extended, None, gain, (float(low), float(high)), files)
