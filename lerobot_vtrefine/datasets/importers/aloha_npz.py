"""The paper authors' ALOHA episodes: one npz of commands and encoder readings, without touch or vision.

Arrays: ``command`` and ``position`` (N, 16) in rad and m, ``length`` (E,) frames per episode, ``joints``
(16,) names. The frame rate is not in the file; about 10 frames a second follow from the fastest gripper
motion.
"""

from pathlib import Path

import numpy as np

from lerobot_vtrefine.datasets.importers.joint_episodes import JointEpisode
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.files.arrays import NUMBERS, TEXTS, WHOLE, read_arrays

KINDS = {"command": NUMBERS, "position": NUMBERS, "length": WHOLE, "joints": TEXTS}
LARGEST_POSITION = 100.0
"""No command or position is further from zero [rad or m]."""
NORMALISED_KEYS = ("actions", "joint_states", "traj_lengths")


def read_aloha_npz(path: Path) -> list[JointEpisode]:
    """Episodes with their columns in the order of the embodiment's joints.

    Raises:
        ValueError: the file is not an npz of this format; says in which respect.
    """
    arrays = read_arrays(path, KINDS | dict.fromkeys(NORMALISED_KEYS, NUMBERS))
    if set(NORMALISED_KEYS) <= set(arrays):
        raise ValueError(f"{path} holds values normalised to [-1, 1]: de-normalise them to rad and m first")
    missing = [key for key in KINDS if key not in arrays]
    if missing:
        raise ValueError(f"{path} has no array {missing[0]!r}; this format has {', '.join(KINDS)}")
    order = _order(path, arrays["joints"])
    command, position, length = arrays["command"], arrays["position"], arrays["length"]
    for name, values in (("command", command), ("position", position)):
        if values.ndim != 2 or values.shape[1] != len(order) or not np.isfinite(values).all():
            raise ValueError(f"{path}: {name} must be finite, (frames, {len(order)}), got {values.shape}")
        if np.abs(values).max(initial=0.0) > LARGEST_POSITION:
            raise ValueError(f"{path}: {name} must be in rad and m, got {np.abs(values).max():g}")
    if length.ndim != 1 or not len(length) or (length < 1).any() or (length > len(command)).any():
        raise ValueError(f"{path}: length must list the frames of at least one episode")
    if not int(length.sum()) == len(command) == len(position):
        counts = f"{int(length.sum())}, {len(command)} and {len(position)}"
        raise ValueError(f"{path}: length, command and position disagree on the frames: {counts}")
    stops = np.cumsum(length)[:-1]
    pairs = zip(np.split(command[:, order], stops), np.split(position[:, order], stops), strict=True)
    return [JointEpisode(c.astype(np.float32), p.astype(np.float32)) for c, p in pairs]


def _order(path: Path, joints: np.ndarray) -> list[int]:
    """Where each of the embodiment's joints is in the file."""
    names = [str(name) for name in joints.ravel()]
    wanted = get_embodiment("aloha").joint_names
    if sorted(names) != sorted(wanted):
        wrong = [name[:60] for name in sorted(set(names) ^ set(wanted))] or ["a repeated one"]
        raise ValueError(f"{path}: joints must be the 16 of ALOHA, but differ in {', '.join(wrong[:4])}")
    return [names.index(name) for name in wanted]
