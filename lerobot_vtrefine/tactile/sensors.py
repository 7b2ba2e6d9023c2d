"""Simulated pads of many environments: poses in, raw counts out, with each environment's state kept here."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from lerobot_vtrefine.tactile.geometry import BodyGeometry
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.poses import ArrayLike, Poses
from lerobot_vtrefine.tactile.stages.base import Frame, Stage, State
from lerobot_vtrefine.tactile.stages.contact import ContactStage
from lerobot_vtrefine.tactile.stages.cover import passed
from lerobot_vtrefine.tactile.stages.readout import Gain

if TYPE_CHECKING:
    from lerobot_vtrefine.tactile.engine import ContactEngine


def _per_env(values: torch.Tensor) -> torch.Tensor:
    """(m,) so that it broadcasts against (m, P, R, C)."""
    return values.view(-1, 1, 1, 1)


class PadSensors:
    """The pads of `num_envs` environments, all touching the same list of bodies.

    Shape legend: m environments named by `ids`, P pads, B bodies, N = rows * cols taxels, row-major.

    Args:
        layout: taxels of every pad.
        bodies: geometry of the B bodies, each in its own frame.
        model: the sensor model.
        device: torch device on which everything is computed.
        seed: used for environments until `reset` gives them their own.
        num_threads: that share the contact's work on CPU; results do not depend on it.
    """

    def __init__(
        self,
        layout: PadLayout,
        bodies: Sequence[BodyGeometry],
        num_envs: int,
        num_pads: int = 4,
        model: SensorModel | None = None,
        device: str = "cpu",
        seed: int = 0,
        num_threads: int = 1,
    ) -> None:
        if num_envs < 1 or num_pads < 1:
            raise ValueError(f"need at least one environment and one pad, got {num_envs} and {num_pads}")
        self.layout, self.bodies = layout, list(bodies)
        self.num_envs, self.num_pads = num_envs, num_pads
        self.model = model or SensorModel.default()
        self.device, self._num_threads = torch.device(device), num_threads
        self._time_s = torch.zeros(num_envs, dtype=torch.float64, device=self.device)
        self._stiffness_scale = torch.ones(num_envs, device=self.device)
        self._gain_scale = torch.ones(num_envs, device=self.device)
        self._parameters: dict[tuple[str, str], torch.Tensor] = {}
        self._state: dict[str, State] = {}
        self._engines: dict[bool, ContactEngine] = {}
        self._baseline = torch.zeros(
            (num_envs, num_pads, layout.num_taxels), dtype=torch.uint8, device=self.device
        )
        self.reset(np.arange(num_envs), seed)

    @property
    def baseline(self) -> np.ndarray:
        """Counts of the untouched taxels (num_envs, P, N) uint8."""
        return self._baseline.cpu().numpy()

    def baseline_counts(self, ids: np.ndarray) -> torch.Tensor:
        """The same of the named environments (m, P, N), on `device`."""
        return self._baseline[torch.as_tensor(ids, device=self.device)]

    def reset(self, ids: np.ndarray, seed: int | np.ndarray | np.random.Generator = 0) -> None:
        """Start new episodes: clear the stages' memory and draw each sensor's own traits.

        Args:
            ids: (m,) environments.
            seed: one per environment (m,), a generator to draw them from, or one number, to which the ids
                are added.
                An environment's readings depend only on its own seed and inputs.
        """
        ids = np.atleast_1d(np.asarray(ids, dtype=np.int64))
        if isinstance(seed, np.random.Generator):
            seeds = seed.integers(0, 2**31, len(ids))
        else:
            seeds = np.asarray(seed, dtype=np.int64)
            seeds = seeds + ids if seeds.ndim == 0 else seeds
        self._time_s[torch.from_numpy(ids)] = 0.0
        for stage in self.model.stages:
            initial = stage.initial(self.layout, self.num_pads)
            drawn = [initial] * len(seeds)
            if type(stage).traits is not Stage.traits:  # a generator costs more than what it draws
                rngs = [np.random.default_rng([int(env_seed), stage.rank]) for env_seed in seeds]
                drawn = [{**initial, **stage.traits(self.layout, self.num_pads, rng)} for rng in rngs]
            self._assign(stage.name, ids, drawn)
        self._update_baseline(ids)

    def _assign(self, name: str, ids: np.ndarray, drawn: list[dict[str, np.ndarray]]) -> None:
        """Write a stage's state into environments `ids` (m,), in one upload per entry."""
        state = self._state.setdefault(name, {})
        for key in drawn[0] if drawn else ():
            tensor = torch.from_numpy(np.stack([values[key] for values in drawn])).to(self.device)
            if key not in state or state[key].shape[1:] != tensor.shape[1:]:
                state[key] = torch.zeros(
                    (self.num_envs, *tensor.shape[1:]), dtype=tensor.dtype, device=self.device
                )
            state[key][torch.from_numpy(ids).to(self.device)] = tensor

    def get_state(self, env: int) -> dict[str, Any]:
        """Everything that one environment's next readings depend on, apart from its poses; a deep copy."""
        stages = {
            name: {key: value[env].clone() for key, value in state.items()}
            for name, state in self._state.items()
        }
        scalars = {
            "time_s": self._time_s,
            "stiffness_scale": self._stiffness_scale,
            "gain_scale": self._gain_scale,
        }
        return {
            "stages": stages,
            "parameters": {key: float(values[env]) for key, values in self._parameters.items()},
            "baseline": self._baseline[env].clone(),
            **{name: float(values[env]) for name, values in scalars.items()},
        }

    def set_state(self, env: int | np.ndarray, state: dict[str, Any]) -> None:
        """Inverse of `get_state`, for any environment of a `PadSensors` with the same layout and model; of
        several environments (m,), values are (m, ...).
        """
        for name, values in state["stages"].items():
            for key, value in values.items():
                self._put(self._state[name][key], env, value)
        for (stage, parameter), value in state["parameters"].items():
            self._put(self._own_parameter(f"{stage}.{parameter}"), env, value)
        self._put(self._time_s, env, state["time_s"])
        self._put(self._stiffness_scale, env, state["stiffness_scale"])
        self._put(self._gain_scale, env, state["gain_scale"])
        self._put(self._baseline, env, state["baseline"])

    def _put(self, own: torch.Tensor, env: int | np.ndarray, value: Any) -> None:
        own[env] = torch.as_tensor(value, dtype=own.dtype, device=self.device)

    def randomize(
        self,
        ids: np.ndarray,
        stiffness_scale: ArrayLike | float | None = None,
        gain_scale: ArrayLike | float | None = None,
        parameters: dict[str, ArrayLike] | None = None,
    ) -> None:
        """Give environments their own parameters; what is None stays.

        Args:
            ids: (m,) environments.
            stiffness_scale, gain_scale: factors on the contact's stiffness and on counts per newton, (m,) or
                one.
            parameters: "stage.parameter" -> values (m,), as `SensorModel.ranges` names them.
        """
        index = torch.as_tensor(np.atleast_1d(ids), dtype=torch.long, device=self.device)
        for own, values in ((self._stiffness_scale, stiffness_scale), (self._gain_scale, gain_scale)):
            if values is not None:
                values = torch.as_tensor(values, dtype=torch.float32, device=self.device)
                if not bool((values > 0).all()):
                    raise ValueError("stiffness_scale and gain_scale must be positive")
                own[index] = values
        for name, values in (parameters or {}).items():
            self._own_parameter(name)[index] = torch.as_tensor(
                values, dtype=torch.float32, device=self.device
            )
        self._update_baseline(np.atleast_1d(ids))

    def _own_parameter(self, name: str) -> torch.Tensor:
        valid = self.model.ranges()
        if name not in valid:
            raise ValueError(f"unknown parameter {name!r}; valid: {', '.join(sorted(valid))}")
        stage_name, parameter = name.split(".")
        key = (stage_name, parameter)
        if key not in self._parameters:
            default = getattr(self.model.find(stage_name), parameter)
            if not isinstance(default, int | float):
                raise ValueError(
                    f"parameter {name!r} is not a number in this model, so it cannot be randomised"
                )
            self._parameters[key] = torch.full((self.num_envs,), float(default), device=self.device)
        return self._parameters[key]

    def _specialised[StageType: Stage](self, stage: StageType, index: torch.Tensor) -> StageType:
        """The stage with each environment's own parameters, shaped (m, 1, 1, 1)."""
        own: dict[str, Any] = {
            parameter: _per_env(values[index])
            for (name, parameter), values in self._parameters.items()
            if name == stage.name
        }
        if isinstance(stage, Gain):
            own["counts_per_n"] = own.get("counts_per_n", stage.counts_per_n) * _per_env(
                self._gain_scale[index]
            )
        return dataclasses.replace(stage, **own) if own else stage

    def _contact_stage(self, index: torch.Tensor) -> ContactStage:
        stage = self._specialised(self.model.contact, index)
        return stage.scaled(_per_env(self._stiffness_scale[index]))

    def _frame(
        self, index: torch.Tensor, dt_s: float, contact: ContactStage, load: ArrayLike | None = None
    ) -> Frame:
        return Frame(
            layout=self.layout,
            dt_s=dt_s,
            time_s=_per_env(self._time_s[index]),
            stiffness_n_per_m=contact.stiffness(self.layout),
            load_conserving=contact.load_conserving and load is not None,
        )

    def _run(
        self, x: torch.Tensor, damping: torch.Tensor | None, index: torch.Tensor, frame: Frame
    ) -> torch.Tensor:
        """Counts from the contact's force and the part of it that damping bears, where that is asked for."""
        everyone = len(index) == self.num_envs and bool(
            (index == torch.arange(self.num_envs, device=self.device)).all()
        )
        for stage in self.model.force_stages:
            state = self._state.get(stage.name, {})
            mine = state if everyone else {key: value[index] for key, value in state.items()}
            own, new = self._specialised(stage, index), mine

            def work(force: torch.Tensor, own: Stage = own, mine: State = mine) -> torch.Tensor:
                nonlocal new
                force, new = own.step(force, mine, frame)
                return force

            x, damping = passed(stage, x, damping, work)
            if everyone:
                self._state[stage.name] = new
                continue
            for key, value in new.items():
                if value is not mine[key]:
                    state[key][index] = value
        return x

    def _update_baseline(self, ids: np.ndarray) -> None:
        index = torch.as_tensor(ids, dtype=torch.long, device=self.device)
        x = torch.zeros((len(ids), self.num_pads, self.layout.rows, self.layout.cols), device=self.device)
        frame = self._frame(index, 0.0, self._contact_stage(index))
        for stage in self.model.force_stages:
            if not (stage.has_state or stage.stochastic):
                state = {key: value[index] for key, value in self._state.get(stage.name, {}).items()}
                x, _ = self._specialised(stage, index).step(x, state, frame)
        self._baseline[index] = x.flatten(2).clamp(0, 255).round().to(torch.uint8)

    def _tensor(self, array: ArrayLike) -> torch.Tensor:
        return torch.as_tensor(array, device=self.device).to(torch.float32)

    def _contact_forces(
        self, contact: ContactStage, poses: Poses, load: ArrayLike | None, frame: Frame
    ) -> torch.Tensor:
        """Forces per taxel (m, P, R, C) [N]."""
        solved = contact.load_conserving and load is not None
        if solved not in self._engines:
            from lerobot_vtrefine.tactile.engine import ContactEngine  # warp is slow to import

            self._engines[solved] = ContactEngine(
                self.layout, self.bodies, self.model, solved, str(self.device), self._num_threads
            )
        loads = None if load is None else self._tensor(load)
        # The engine reuses its buffers, while callers and stages with memory may keep what they get.
        return self._engines[solved](contact, [self._tensor(pose) for pose in poses], loads, frame).clone()

    def forces(self, ids: np.ndarray, poses: Poses, dt_s: float, load: ArrayLike | None = None) -> ArrayLike:
        """Contact force per taxel before mechanics and readout: (m, P, N) float32 [N]; arguments as in
        `counts`."""
        index = torch.as_tensor(np.atleast_1d(ids), dtype=torch.long, device=self.device)
        contact = self._contact_stage(index)
        force = self._contact_forces(contact, poses, load, self._frame(index, dt_s, contact, load)).flatten(2)
        return force if isinstance(poses.pad_pos, torch.Tensor) else force.cpu().numpy()

    def counts(self, ids: np.ndarray, poses: Poses, dt_s: float, load: ArrayLike | None = None) -> ArrayLike:
        """Raw counts (m, P, N) uint8 of the named environments; advances their state by one frame of `dt_s`.

        Args:
            ids: (m,) environments, without repetition.
            dt_s: time since the previous frame [s].
            load: (m, P, 3) the solver's normal force on each pad [N] and its centre x, y in the pad frame
                [m].

        Returns numpy for numpy poses, a tensor on `device` for tensors.
        """
        index = torch.as_tensor(np.atleast_1d(ids), dtype=torch.long, device=self.device)
        contact = self._contact_stage(index)
        frame = self._frame(index, dt_s, contact, load)
        force, damping = self._contact_forces(contact, poses, load, frame), None
        if self.model.parts_forces:
            damping = force - self._contact_forces(contact.undamped(), poses, load, frame)
        counts = self._run(force, damping, index, frame)
        self._time_s[index] += dt_s
        counts = counts.flatten(2).clamp(0.0, 255.0).to(torch.uint8)
        return counts if isinstance(poses.pad_pos, torch.Tensor) else counts.cpu().numpy()
