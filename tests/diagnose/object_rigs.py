"""Episodes in which parts are picked up, inserted, wiggled or dragged in a simulation with hidden physics.

Recorded as a robot would: joint positions, commands, pads' counts. The engine under test is not used here.
"""

import io
import json
from dataclasses import asdict, dataclass

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from PIL import Image

from lerobot_vtrefine.datasets.episodes import RecordedEpisode
from lerobot_vtrefine.datasets.features import (
    ACTION_KEY,
    CAMERA_POSE_KEY,
    DEPTH_KEY,
    INTRINSICS_KEY,
    STATE_KEY,
    baseline_keys,
    tactile_keys,
)
from lerobot_vtrefine.embodiments import Embodiment, get_embodiment
from lerobot_vtrefine.sim.config import RandomizationConfig, TaskConfig
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.expert import Phase, ScriptedExpert
from lerobot_vtrefine.sim.ik import solve_hands
from lerobot_vtrefine.sim.simulation import InsertionSim

WIGGLE_M, WIGGLE_STEPS = 0.010, 48
DRAG_M, PRESS_M, DRAG_STEPS = 0.03, 0.018, 60


@dataclass(frozen=True)
class Recorded:
    body: Embodiment
    episodes: list
    rules: TaskConfig
    depth_mm: np.ndarray | None
    camera: tuple


def record(scene, count, what="pick", seed=0, degradation=None, faults=None, depth=False):
    """what: pick (the expert's episode), wiggle (then sideways in the socket), drag (along the table)."""
    body, rules = get_embodiment(scene.embodiment), TaskConfig(episode_steps=400)
    sim = InsertionSim(scene, rules, num_envs=count, robot_faults=faults)
    expert = ScriptedExpert(sim, degradation or Degradation())
    ids = np.arange(count)
    sim.reset(ids, seed + ids)
    expert.reset(ids)
    takes = {"pick": None, "wiggle": Phase.HOLD, "drag": Phase.LIFT}[what]
    steps = {"pick": 90, "wiggle": 90 + WIGGLE_STEPS, "drag": 40 + DRAG_STEPS}[what]
    since, base, target = np.full(count, -1), [None] * count, np.zeros((count, body.num_joints))
    rows, images = {"state": [], "tactile": [], "action": []}, []
    for _ in range(steps):
        seen = {"state": sim.joint_state(ids), "tactile": sim.tactile(ids)}
        if depth:
            images.append(sim.depth_mm(ids))
        action = expert.act(ids)
        for k in ids if takes is not None else ():
            if since[k] < 0 and expert.phase[k] >= takes:
                since[k], target[k] = 0, action[k]
                base[k] = [x.numpy()[0] for x in body.tcp_poses(torch.as_tensor(action[k][None]))]
            if since[k] >= 0:
                action[k] = target[k] = moved(body, base[k], target[k], what, since[k])
                since[k] += 1
        sim.step(action, ids)
        for key, value in {**seen, "action": action}.items():
            rows[key].append(np.asarray(value).copy())
    idle = sim.observe(ids)["tactile_baseline"]
    stacked = {key: np.stack(values, 1) for key, values in rows.items()}
    episodes = [episode(body, k, stacked, idle, rules) for k in ids]
    camera = sim.camera_intrinsics, sim.camera_pose[0]
    return Recorded(body, episodes, rules, np.stack(images, 1) if depth else None, camera)


def moved(body, base, q, what, step):
    """Joint targets of the right hand's next place, from where it was when it was taken over."""
    position, rotation = base[0].copy(), base[1]
    if what == "wiggle":
        position[1, 0] += WIGGLE_M * np.sin(2 * np.pi * step / (WIGGLE_STEPS / 2))
    else:
        position[1, 2] -= PRESS_M * min(step / 8, 1.0)
        position[1, 0] += DRAG_M * np.sin(2 * np.pi * max(step - 8, 0) / ((DRAG_STEPS - 8) / 2))
    new, _, _ = solve_hands(body, position[None], rotation[None], q[None])
    body.set_grippers(new, q[None])
    return np.concatenate([q[: body.joints_per_arm], new[0, body.joints_per_arm :]])


def episode(body, index, rows, idle, rules):
    counts = {name: rows["tactile"][index, :, pad] for pad, name in enumerate(body.pad_names)}
    baselines = {name: idle[index, pad] for pad, name in enumerate(body.pad_names)}
    time_s = rules.control_dt_s * np.arange(rows["state"].shape[1])
    state, action = (rows[key][index].astype(np.float32).astype(float) for key in ("state", "action"))
    return RecordedEpisode(index, time_s, state, action, counts, baselines)


def write_dataset(root, recorded, believed, pose=None, depth_scale=1.0):
    """A LeRobot dataset with its note of the scene that is believed; pose and scale of the camera may lie."""
    tables = [_table(recorded, k, pose, depth_scale) for k in range(len(recorded.episodes))]
    (root / "data").mkdir(parents=True)
    (root / "meta").mkdir()
    pq.write_table(pa.concat_tables(tables), root / "data" / "file-000.parquet")
    body = recorded.body
    joints = {"dtype": "float32", "shape": [body.num_joints], "names": list(body.joint_names)}
    pad = {"dtype": "uint8", "shape": [body.pad_layout.num_taxels], "names": None}
    touches = dict.fromkeys((*tactile_keys(body), *baseline_keys(body)), pad)
    features = {STATE_KEY: joints, ACTION_KEY: joints} | touches
    info = {"codebase_version": "v3.0", "fps": 10, "total_episodes": len(tables), "features": features}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    settings = {
        "scene": asdict(believed),
        "rules": asdict(recorded.rules),
        "randomization": asdict(RandomizationConfig()),
        "sensor_model": "default",
        "task": "insert",
    }
    ledger = {"settings": settings, "episodes": [{"episode_index": k, "seed": 0} for k in range(len(tables))]}
    (root / "meta" / "recording.json").write_text(json.dumps(ledger))
    return root


def _table(recorded, index, pose, depth_scale):
    one, body = recorded.episodes[index], recorded.body
    count = len(one.time_s)
    columns = {
        "episode_index": pa.array([index] * count),
        "frame_index": pa.array(range(count)),
        "timestamp": pa.array(one.time_s.astype(np.float32)),
        STATE_KEY: pa.array(one.state.astype(np.float32).tolist(), pa.list_(pa.float32())),
        ACTION_KEY: pa.array(one.action.astype(np.float32).tolist(), pa.list_(pa.float32())),
    }
    for keys, values in ((tactile_keys(body), one.counts), (baseline_keys(body), one.baselines)):
        for key, name in zip(keys, body.pad_names, strict=True):
            rows = np.broadcast_to(values[name], (count, body.pad_layout.num_taxels)).tolist()
            columns[key] = pa.array(rows, pa.list_(pa.uint8()))
    if recorded.depth_mm is not None:
        intrinsics, true_pose = recorded.camera
        columns[INTRINSICS_KEY] = pa.array([intrinsics.tolist()] * count)
        columns[CAMERA_POSE_KEY] = pa.array([(true_pose if pose is None else pose).tolist()] * count)
        columns[DEPTH_KEY] = pa.array([_tiff(depth_scale * image) for image in recorded.depth_mm[index]])
    return pa.table(columns)


def _tiff(image_mm):
    file = io.BytesIO()
    Image.fromarray(np.round(image_mm).astype(np.uint16)).save(file, "TIFF")
    return {"bytes": file.getvalue(), "path": None}
