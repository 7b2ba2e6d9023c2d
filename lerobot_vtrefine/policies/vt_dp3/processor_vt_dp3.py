"""Pre- and postprocessing of ``vt_dp3``: raw readings to cloud and normalised state, actions to joint
targets.

The same pipeline, saved with the checkpoint, serves training batches (B, To, ...), environment frames (B,
...) and robot frames; so all of them see the same cloud.
"""

from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    NormalizerProcessorStep,
    ObservationProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStepRegistry,
    RenameObservationsProcessorStep,
    UnnormalizerProcessorStep,
)
from lerobot.processor.factory import make_policy_processor_pipelines
from torch import Tensor

from lerobot_vtrefine.datasets.features import (
    ACTION_KEY,
    CAMERA_POSE_KEY,
    CLOUD_KEY,
    DEPTH_KEY,
    GRIDS_KEY,
    INTRINSICS_KEY,
    LIMITS_KEY,
    NOISE_LEVEL_KEY,
    STATE_KEY,
    TRUTH_KEY,
    baseline_keys,
    raw_keys,
    tactile_keys,
)
from lerobot_vtrefine.embodiments import Embodiment, get_embodiment
from lerobot_vtrefine.observation import VisuoTactileConfig, build_visuo_tactile, num_points
from lerobot_vtrefine.observation.grids import pad_grids
from lerobot_vtrefine.observation.visuo_tactile import POINT_CHANNELS
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config

MIN_RANGE = 0.02
"""Smallest range [rad, m or N] that min-max normalisation stretches to [-1, 1]."""

Stats = dict[str, dict[str, Any]]
Pipelines = tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]


def widen_narrow_ranges(stats: Stats) -> None:
    """Give what hardly moved or differed in the data a range of ``MIN_RANGE`` around their middle, in place.

    Without it a joint that stayed within 1e-6 rad would turn the servo's noise into huge inputs. Idempotent.
    """
    for key in (STATE_KEY, LIMITS_KEY, TRUTH_KEY, ACTION_KEY):
        if key not in stats or "min" not in stats[key]:
            continue
        low, high = torch.as_tensor(stats[key]["min"]), torch.as_tensor(stats[key]["max"])
        middle, half = (low + high) / 2, (high - low) / 2
        narrow = half < MIN_RANGE / 2
        stats[key]["min"] = torch.where(narrow, middle - MIN_RANGE / 2, low).numpy()
        stats[key]["max"] = torch.where(narrow, middle + MIN_RANGE / 2, high).numpy()


def check_stats(config: VtDp3Config, stats: Stats | None, root: Any) -> None:
    """Refuse the statistics of a dataset in ``root`` where what is to be normalised would not be, or to nan.

    LeRobot's normaliser leaves a column without statistics as it is, and samples, which are clamped to
    [-1, 1], would then never reach some joint angles.

    Raises: ValueError naming the column.
    """
    features = {**(config.input_features or {}), **(config.output_features or {})}
    for key in (*config.normalised_keys, ACTION_KEY):
        mode = config.normalization_mapping.get(features[key].type.value, NormalizationMode.IDENTITY)
        if mode is NormalizationMode.IDENTITY:
            continue
        known = (stats or {}).get(key)
        if not known or not all(torch.as_tensor(value).isfinite().all() for value in known.values()):
            which = "not only finite" if known else "no"
            raise ValueError(
                f"{root}/meta/stats.json has {which} statistics of {key}, by which vt_dp3 normalises:"
                " see that its values are finite, and make them anew by lerobot-edit-dataset"
                " --operation.type=recompute_stats"
            )


@ProcessorStepRegistry.register("vt_visuo_tactile")
@dataclass
class VisuoTactileProcessorStep(ObservationProcessorStep):
    """Replaces the raw tactile, depth and camera columns by ``observation.visuo_tactile`` (..., N, 5) and,
    with ``fusion=pads``, ``observation.tactile_grids`` (..., P, R, C).

    Leading dimensions are those of ``observation.state`` (..., J), which must still be in rad and m here.
    Depth noise is drawn from torch's global generator, so LeRobot's seed makes it repeatable.
    """

    observation_config: VisuoTactileConfig = field(default_factory=VisuoTactileConfig)
    modalities: str = "visuo_tactile"
    """What the cloud holds; empty for none."""
    grids: bool = False
    """Whether pads become images."""

    def __post_init__(self) -> None:
        if isinstance(self.observation_config, dict):  # as loaded from a saved pipeline
            self.observation_config = _loaded_config(self.observation_config)
        self.observation_config.validate()

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Build cloud and images, and drop what they were built from; masks (``*_is_pad``) stay untouched."""
        used = raw_keys(self._body)
        built = {key: value for key, value in observation.items() if key not in used}
        if self.modalities:
            built[CLOUD_KEY] = self._cloud(observation)
        if self.grids:
            counts = self._counts(observation)
            built[GRIDS_KEY] = pad_grids(*counts, self._grid_shape, self.observation_config)
        return built

    @property
    def _grid_shape(self) -> tuple[int, int]:
        layout = self._body.pad_layout
        return layout.rows, layout.cols

    @property
    def _body(self) -> Embodiment:
        return get_embodiment(self.observation_config.embodiment)

    def _cloud(self, observation: dict[str, Any]) -> Tensor:
        tactile = baseline = depth = intrinsics = pose = None
        if self.modalities != "visual":
            tactile, baseline = self._counts(observation)
        if self.modalities != "tactile":
            depth = _require(observation, DEPTH_KEY)
            intrinsics, pose = _require(observation, INTRINSICS_KEY), _require(observation, CAMERA_POSE_KEY)
        return build_visuo_tactile(
            _require(observation, STATE_KEY),
            tactile,
            baseline,
            depth,
            intrinsics,
            pose,
            self.observation_config,
            noise_level=observation.get(NOISE_LEVEL_KEY),
        )

    def _counts(self, observation: dict[str, Any]) -> tuple[Tensor, Tensor]:
        """Counts of all pads and their idle counts, (..., P, taxels) each."""
        lead = _require(observation, STATE_KEY).shape[:-1]
        touch, idle = (
            torch.stack([_require(observation, key).reshape(*lead, -1) for key in keys], dim=-2)
            for keys in (tactile_keys(self._body), baseline_keys(self._body))
        )
        return touch, idle

    def get_config(self) -> dict[str, Any]:
        """Saved with the checkpoint."""
        return {
            "observation_config": asdict(self.observation_config),
            "modalities": self.modalities,
            "grids": self.grids,
        }

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """The raw columns' features become those of cloud and images."""
        observations, used = features.get(PipelineFeatureType.OBSERVATION, {}), raw_keys(self._body)
        kept = {key: value for key, value in observations.items() if key not in used}
        if self.modalities:
            points = num_points(self.observation_config, self.modalities)
            kept[CLOUD_KEY] = PolicyFeature(type=FeatureType.STATE, shape=(points, POINT_CHANNELS))
        if self.grids:
            shape = (len(self._body.pad_names), *self._grid_shape)
            kept[GRIDS_KEY] = PolicyFeature(type=FeatureType.STATE, shape=shape)
        return {**features, PipelineFeatureType.OBSERVATION: kept}


def _loaded_config(values: dict[str, Any]) -> VisuoTactileConfig:
    """The configuration from its JSON form, where tuples have become lists."""
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return VisuoTactileConfig(**fields)


def _require(observation: dict[str, Any], key: str) -> Tensor:
    if key not in observation:
        raise ValueError(
            f"the observation lacks '{key}' and has {', '.join(sorted(observation))}: a vt_dp3 needs"
            " the pads and the camera of the robot that its demonstrations are of"
        )
    return torch.as_tensor(observation[key])


def make_vt_dp3_pre_post_processors(
    config: VtDp3Config, dataset_stats: Stats | None = None, dataset_meta: Any = None
) -> Pipelines:
    """Pre- and postprocessor; joint positions, actions, limits and an auxiliary loss's truth are normalised
    (min-max to [-1, 1]), and nothing else.
    """
    seen = config.normalised_keys
    if dataset_stats:
        widen_narrow_ranges(dataset_stats)
        dataset_stats = {key: dataset_stats[key] for key in (*seen, ACTION_KEY) if key in dataset_stats}
    norm_map = {FeatureType(kind): mode for kind, mode in config.normalization_mapping.items()}
    normalizer = NormalizerProcessorStep(
        features={**(config.input_features or {}), **(config.output_features or {})},
        norm_map=norm_map,
        stats=dataset_stats,
        normalize_observation_keys=set(seen),
    )
    unnormalizer = UnnormalizerProcessorStep(
        features=config.output_features or {}, norm_map=norm_map, stats=dataset_stats
    )
    return make_policy_processor_pipelines(
        input_steps=[
            RenameObservationsProcessorStep(rename_map={}),
            AddBatchDimensionProcessorStep(),
            DeviceProcessorStep(device=config.device or "cpu"),
            VisuoTactileProcessorStep(config.observation, config.cloud_modalities, config.sees_grids),
            normalizer,
        ],
        output_steps=[unnormalizer, DeviceProcessorStep(device="cpu")],
    )
