"""Differences between worlds: drawn from the episode's seed, written into the worlds' own model fields.

Clearance changes geometry and inertia of the socket, so its values lie on a fixed ladder of compiled models.
"""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.sim.config import RANGES, RandomizationConfig, SceneConfig
from lerobot_vtrefine.sim.rotations import about_axis
from lerobot_vtrefine.sim.scene import Scene, build_scene
from lerobot_vtrefine.sim.starts import uniform_draws

Array = np.ndarray

_STREAM, _LIMIT_STREAM = 1, 0xF0
CLEARANCE_LEVELS = 9
# All that a hole's size changes in a compiled model; the constants derived from them are recomputed per
# world.
GEOMETRY_FIELDS = (
    "geom_pos",
    "geom_size",
    "geom_aabb",
    "geom_rbound",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "bvh_aabb",
)
_CAMERA_DRAWS = 6


@dataclass(frozen=True)
class WorldParameters:
    """Physical parameters of m worlds."""

    values: dict[str, Array]
    """Name in `RANGES` -> (m,)."""
    camera_position: Array
    """(m, 3) [m]"""
    camera_rotation: Array
    """(m, 3, 3)"""


def _unit_draws(seeds: Array, stream: int, count: int, wanted: bool) -> Array:
    """(m, count) in [0, 1]: the middle where none are wanted, since a generator for every seed takes long."""
    return (uniform_draws(seeds, stream, count) + 1.0) / 2 if wanted else np.full((len(seeds), count), 0.5)


class Randomizer:
    """Draws parameters per world and turns them into model fields."""

    def __init__(self, scene: Scene, config: RandomizationConfig) -> None:
        if config.clearance_m is not None and scene.config.pair.startswith("automate/"):
            raise ValueError(
                "randomization.clearance_m is for procedural pairs: mesh pairs have their own clearance"
            )
        if config.clearance_m is not None and scene.config.negative_control_m:
            raise ValueError("randomization.clearance_m and negative_control_m exclude each other")
        self._scene, self._config = scene, config
        self._clearances, self._ladder = self._compile_ladder()

    @property
    def changes_physics(self) -> bool:
        """Whether any world's model differs from the scene's."""
        return any(getattr(self._config, name) is not None for name in RANGES[:-1])

    def draw(self, seeds: Array) -> WorldParameters:
        """Parameters for episodes with these seeds (m,)."""
        unit = _unit_draws(seeds, _STREAM, len(RANGES) + _CAMERA_DRAWS, self._draws_parameters)
        nominal = self._nominal()
        values = {}
        for index, name in enumerate(RANGES):
            bounds = getattr(self._config, name)
            low, high = bounds if bounds is not None else (nominal[name], nominal[name])
            values[name] = low + (high - low) * unit[:, index]
        if self._ladder:
            values["clearance_m"] = self._clearances[self._level(values["clearance_m"])]
        offset = 2 * unit[:, len(RANGES) :] - 1
        camera = self._scene.camera
        turns = self._config.camera_rotation_rad * offset[:, 3:]
        rotation = camera.rotation @ about_axis(0, turns[:, 0]) @ about_axis(1, turns[:, 1])
        return WorldParameters(
            values,
            camera.position_m + self._config.camera_position_m * offset[:, :3],
            rotation @ about_axis(2, turns[:, 2]),
        )

    @property
    def _draws_parameters(self) -> bool:
        camera = self._config.camera_position_m or self._config.camera_rotation_rad
        return bool(camera) or any(getattr(self._config, name) is not None for name in RANGES)

    @property
    def varies_force_limit(self) -> bool:
        """Whether the limit on force differs between episodes."""
        return self._config.contact_force_n is not None

    def force_limits(self, seeds: Array, nominal_n: float) -> Array:
        """Limits on force [N] for episodes with these seeds (m,): a stream of their own, so that they change
        nothing else of an episode.
        """
        low, high = self._config.contact_force_n or (nominal_n, nominal_n)
        return low + (high - low) * _unit_draws(seeds, _LIMIT_STREAM, 1, self.varies_force_limit)[:, 0]

    def model_fields(self, parameters: WorldParameters) -> dict[str, Array]:
        """Values (m, ...) of every MjModel field that these worlds have of their own."""
        values, model = parameters.values, self._scene.model
        count = len(values["clearance_m"])
        out: dict[str, Array] = {}
        if self._ladder:
            level = self._level(values["clearance_m"])
            for name in GEOMETRY_FIELDS:
                out[name] = np.stack([self._ladder[index][name] for index in level])
        if self._config.part_mass_scale is not None:
            bodies = [self._scene.plug_body, self._scene.socket_body]
            scale = values["part_mass_scale"][:, None]
            for name in ("body_mass", "body_inertia"):
                field = out.setdefault(name, _repeat(getattr(model, name), count))
                field[:, bodies] *= scale.reshape(count, 1, *[1] * (field.ndim - 2))
        self._contact_fields(parameters, out, count)
        return out

    def _contact_fields(self, parameters: WorldParameters, out: dict[str, Array], count: int) -> None:
        values, model, config = parameters.values, self._scene.model, self._config
        pads, parts = self._scene.addresses.pad_geoms, self._scene.addresses.part_geoms
        if config.pad_friction is not None or config.part_friction is not None:
            friction = _repeat(model.geom_friction, count)
            friction[:, pads, 0] = values["pad_friction"][:, None]
            friction[:, parts, 0] = values["part_friction"][:, None]
            out["geom_friction"] = friction
        if config.pad_stiffness_scale is not None:
            solref = _repeat(model.geom_solref, count)
            # Stiffness goes with the inverse square of the time constant.
            solref[:, pads, 0] /= np.sqrt(values["pad_stiffness_scale"])[:, None]
            out["geom_solref"] = solref

    def _nominal(self) -> dict[str, float]:
        config = self._scene.config
        return {
            "clearance_m": config.hole_clearance_m,
            "pad_friction": config.pad_friction,
            "part_friction": config.part_friction,
            "part_mass_scale": 1.0,
            "pad_stiffness_scale": 1.0,
            "sensor_gain_scale": 1.0,
        }

    def _level(self, clearance: Array) -> Array:
        return np.abs(clearance[:, None] - self._clearances).argmin(1)

    def _compile_ladder(self) -> tuple[Array, list[dict[str, Array]]]:
        if self._config.clearance_m is None:
            return np.zeros(0), []
        clearances = np.linspace(*self._config.clearance_m, CLEARANCE_LEVELS)
        return clearances, [_geometry(self._scene.config, float(value)) for value in clearances]


def _geometry(config: SceneConfig, clearance_m: float) -> dict[str, Array]:
    model = build_scene(replace(config, clearance_m=clearance_m)).model
    fields = {name: getattr(model, name).copy() for name in GEOMETRY_FIELDS}
    # Batches keep the bodies' bounding volumes only, which come first.
    fields["bvh_aabb"] = fields["bvh_aabb"][: int(model.body_bvhnum.sum())]
    return fields


def _repeat(field: Array, count: int) -> Array:
    return np.repeat(field[None], count, 0)
