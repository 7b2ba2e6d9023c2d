"""What a diagnosis saves is what DPPO trains in: the file goes into the simulation as it is."""

import numpy as np
from test_pipeline import SMALL
from tiny_policy import ReachEnv, save_tiny_checkpoint

from lerobot_vtrefine.cli.finetune import main
from lerobot_vtrefine.envs.factory import make_simulation
from lerobot_vtrefine.finetune import pipeline
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.hysteresis import Hysteresis
from lerobot_vtrefine.tactile.stages.readout import Gain, Idle, Quantisation


def test_extended_model_reaches_the_simulation_of_dppo(tmp_path, monkeypatch):
    idle = np.random.default_rng(0).integers(10, 40, (12, 32)).astype(float)
    model = SensorModel(
        (
            KelvinVoigt(420.0, 1.1),
            Hysteresis(0.2, 3e-4),
            Gain(480.0),
            Idle(idle.tolist(), 0.0),
            Quantisation(),
        )
    )
    model.save(tmp_path / "sensor_model.json")
    seen = []

    def environment(env, num_envs, *rest):
        seen.append(env)
        return ReachEnv(num_envs)

    monkeypatch.setattr(pipeline, "make_decision_env", environment)
    start = save_tiny_checkpoint(tmp_path / "start")
    flags = [f"--policy.path={start}", f"--output_dir={tmp_path / 'out'}", "--dppo.iterations=1", *SMALL]
    flags.append(f"--env.sensor_model={tmp_path / 'sensor_model.json'}")
    monkeypatch.setattr("sys.argv", ["vtrefine-finetune", *flags])

    assert main() == 0
    sim = make_simulation(seen[0], 1)
    sim.reset(np.arange(1), np.array([0]))
    np.testing.assert_array_equal(sim.observe()["tactile_baseline"][0, 2], idle.ravel())
