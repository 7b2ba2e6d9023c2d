"""Pads of many environments: independence, seeds, snapshots, plausible counts, and what import costs."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_vtrefine.tactile import BodyGeometry, Box, PadLayout, PadSensors, Poses, SensorModel, Sphere
from lerobot_vtrefine.tactile.stages.base import STAGES
from lerobot_vtrefine.tactile.stages.contact import Depth, FlexitacIsaacSim, KelvinVoigt, TacSL
from lerobot_vtrefine.tactile.stages.host import Latency, SampleAndHold
from lerobot_vtrefine.tactile.stages.hysteresis import Hysteresis
from lerobot_vtrefine.tactile.stages.mechanics import ViscoelasticRelaxation
from lerobot_vtrefine.tactile.stages.readout import TaxelGainSpread

LAYOUT = PadLayout()
BODIES = [BodyGeometry([Box((0.0165, 0.02, 0.017))]), BodyGeometry([Sphere(0.01)])]
STATEFUL = (
    SensorModel.default()
    .with_stage(Hysteresis())
    .with_stage(ViscoelasticRelaxation())
    .with_stage(Latency(tau_s=0.03))
    .with_stage(SampleAndHold(period_s=0.2))
    .with_stage(TaxelGainSpread())
)


def everything() -> SensorModel:
    model = SensorModel.default()
    for cls in STAGES.values():
        if cls.domain not in ("contact", "gain"):
            model = model.with_stage(cls())
    return model


def scene(count: int, seed: int = 0) -> dict[str, Any]:
    """Random grasps of `count` environments: arguments of `PadSensors.counts` after `ids`."""
    rng = np.random.default_rng(seed)
    eye = np.eye(3)
    body = np.zeros((count, 2, 3))
    body[:, :, 2] = [0.017, 0.01]
    body[:, 1, 0] = 0.027
    body[:, :, 2] -= rng.uniform(0, 4e-4, (count, 2))
    load = np.zeros((count, 4, 3))
    load[..., 0] = rng.uniform(5, 20, (count, 4))
    poses = Poses(
        pad_pos=rng.normal(0, 1e-4, (count, 4, 3)),
        pad_rot=np.broadcast_to(eye, (count, 4, 3, 3)),
        pad_vel=rng.normal(0, 0.01, (count, 4, 6)),
        body_pos=body,
        body_rot=np.broadcast_to(eye, (count, 2, 3, 3)),
        body_vel=np.zeros((count, 2, 6)),
    )
    return {"poses": poses, "dt_s": 0.1, "load": load}


def part(arguments: dict[str, Any], ids: list[int]) -> dict[str, Any]:
    poses = Poses(*(pose[ids] for pose in arguments["poses"]))
    return {"poses": poses, "dt_s": arguments["dt_s"], "load": arguments["load"][ids]}


@pytest.mark.parametrize(
    "model", [SensorModel.default(), SensorModel.paper(), STATEFUL], ids=["default", "paper", "state"]
)
def test_environments_are_independent(model: SensorModel) -> None:
    """Whatever is stepped together, in whatever order, readings follow from an environment's own inputs."""
    together = PadSensors(LAYOUT, BODIES, 4, model=model)
    apart = PadSensors(LAYOUT, BODIES, 4, model=model)
    seeds = np.array([7, 8, 9, 10])
    together.reset(np.arange(4), seeds)
    for env in (2, 0, 3, 1):
        apart.reset([env], seeds[[env]])
    for frame in range(4):
        arguments = scene(4, frame)
        whole = together.counts(np.arange(4), **arguments)
        for ids in ([3, 1], [0], [2]):
            assert np.array_equal(apart.counts(ids, **part(arguments, ids)), whole[ids])
    assert np.array_equal(together.baseline, apart.baseline)


def test_reset_repeats_an_episode_exactly() -> None:
    sensors = PadSensors(LAYOUT, BODIES, 2, model=everything())
    runs = []
    for _ in range(2):
        sensors.reset([0, 1], np.array([3, 4]))
        runs.append([sensors.counts([0, 1], **scene(2, frame)) for frame in range(3)])
    assert np.array_equal(runs[0], runs[1])
    sensors.reset([0, 1], np.array([5, 4]))
    other = [sensors.counts([0, 1], **scene(2, frame)) for frame in range(3)]
    assert not np.array_equal(np.array(other)[:, 0], np.array(runs[0])[:, 0])
    assert np.array_equal(np.array(other)[:, 1], np.array(runs[0])[:, 1])


def test_snapshot_continues_exactly() -> None:
    sensors, other = (PadSensors(LAYOUT, BODIES, 3, model=STATEFUL, seed=seed) for seed in (0, 1))
    sensors.randomize(
        [1],
        stiffness_scale=1.5,
        gain_scale=0.7,
        parameters={"noise.sigma_counts": [0.3], "consistent.damping_s": [0.0]},
    )
    sensors.counts([1], **scene(1, 0))
    other.set_state(2, sensors.get_state(1))
    for frame in (1, 2):
        assert np.array_equal(sensors.counts([1], **scene(1, frame)), other.counts([2], **scene(1, frame)))
    assert np.array_equal(sensors.baseline[1], other.baseline[2])


def test_firm_grasp_reads_plausible_counts() -> None:
    """20 N on about 100 taxels: 60 to 150 counts in all, over an idle level of 10 to 40."""
    sensors = PadSensors(LAYOUT, [BodyGeometry([Box((0.009, 0.02, 0.017))])], 1, num_pads=1)
    poses = Poses(*(pose[:, :1] for pose in scene(1)["poses"]))._replace(pad_pos=np.zeros((1, 1, 3)))
    arguments = {"poses": poses, "dt_s": 0.1, "load": np.array([[[20.0, 0.0, 0.0]]])}
    counts = sensors.counts([0], **arguments)[0, 0]
    force = sensors.forces([0], **arguments)[0, 0]
    assert 90 <= (force > 0).sum() <= 120
    assert 60 <= np.median(counts[force > 0]) <= 150
    assert sensors.baseline.min() >= 10
    assert sensors.baseline.max() <= 40
    assert abs(np.median(counts[force == 0].astype(int) - sensors.baseline[0, 0][force == 0])) <= 1


def test_parameters_per_environment_change_only_theirs() -> None:
    sensors = PadSensors(LAYOUT, BODIES, 2, model=SensorModel.default().without("noise"))
    before = sensors.counts([0, 1], **scene(2))
    sensors.randomize([1], parameters={"row_sharing.conductance_per_count": [2e-3]})
    after = sensors.counts([0, 1], **scene(2))
    assert np.array_equal(before[0], after[0])
    assert after[1].sum() < before[1].sum()
    sensors.randomize([0], gain_scale=[2.0])
    assert sensors.counts([0, 1], **scene(2))[0].sum() > after[0].sum()
    with pytest.raises(ValueError, match=r"unknown parameter 'gain.gain'; valid: "):
        sensors.randomize([0], parameters={"gain.gain": [1.0]})
    with pytest.raises(ValueError, match=r"must be positive"):
        sensors.randomize([0], stiffness_scale=-1.0)


def test_penalty_models_follow_their_formulas() -> None:
    arguments = scene(1)
    moving = np.array([[[0, 0, -0.01, 0, 0, 0], [0, 0, 0.01, 0, 0, 0]]])
    arguments["poses"] = arguments["poses"]._replace(pad_vel=np.zeros((1, 4, 6)), body_vel=moving)
    force = {}
    for law in (Depth(), TacSL(k_n=300.0), KelvinVoigt(k_n=300.0, k_d=2.0), FlexitacIsaacSim()):
        sensors = PadSensors(LAYOUT, BODIES, 1, model=SensorModel.default().with_stage(law))
        force[law.name] = sensors.forces([0], **arguments)
    depth = force["depth"]
    x = LAYOUT.positions()[:, 0]
    rate = np.where(x < 0.02, 0.01, -0.01)
    interior = (depth > 0) & (np.abs(x) < 0.015)
    assert np.allclose(force["tacsl"], 300 * depth)
    assert np.allclose(force["kelvin_voigt"][interior], (300 * depth + 2 * rate)[interior], rtol=1e-4)
    assert (force["kelvin_voigt"] >= 0).all()
    assert (force["kelvin_voigt"][depth == 0] == 0).all()
    assert np.allclose(force["flexitac_isaacsim"], np.clip(5000 * depth, 0, 10) / 10, atol=1e-6)


def test_tensors_in_tensors_out() -> None:
    sensors, other = (PadSensors(LAYOUT, BODIES, 2) for _ in range(2))
    arguments = scene(2)
    tensors = Poses(*(torch.as_tensor(pose) for pose in arguments["poses"]))
    counts = sensors.counts([0, 1], tensors, 0.1, torch.as_tensor(arguments["load"]))
    assert isinstance(counts, torch.Tensor)
    assert counts.dtype == torch.uint8
    assert np.array_equal(counts.numpy(), other.counts([0, 1], **arguments))


def test_importing_costs_no_warp() -> None:
    code = "import sys, lerobot_vtrefine.tactile.replay; sys.exit('warp' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_zero_environments_are_refused() -> None:
    with pytest.raises(ValueError, match=r"at least one environment"):
        PadSensors(LAYOUT, BODIES, 0)


@pytest.mark.parametrize("law", ["consistent", "kelvin_voigt"])
def test_threads_change_nothing(law: str) -> None:
    model = SensorModel.default().with_stage(STAGES[law]())
    alone, shared = (PadSensors(LAYOUT, BODIES, 7, model=model, num_threads=count) for count in (1, 3))
    assert np.array_equal(alone.counts(np.arange(7), **scene(7)), shared.counts(np.arange(7), **scene(7)))
    assert np.array_equal(alone.counts([4], **scene(1)), shared.counts([4], **scene(1)))


@pytest.mark.gpu
def test_cuda_agrees_with_cpu() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    arguments = scene(8)
    for law in ("consistent", "kelvin_voigt"):
        model = SensorModel.default().with_stage(STAGES[law]())
        forces = [
            PadSensors(LAYOUT, BODIES, 8, model=model, device=device).forces(np.arange(8), **arguments)
            for device in ("cpu", "cuda")
        ]
        assert np.abs(forces[0] - forces[1]).max() < 1e-5 * forces[0].max() + 1e-6
    counts = [
        PadSensors(LAYOUT, BODIES, 8, model=everything(), device=device).counts(np.arange(8), **arguments)
        for device in ("cpu", "cuda")
    ]
    assert np.abs(counts[0].astype(int) - counts[1].astype(int)).max() <= 1
