"""Pads files, and what the emulator of pads is given."""

import json
import random
from pathlib import Path

import mutants
import numpy as np
from mutant_kind import Kind

from lerobot_vtrefine.cli import pad_emulator, view_pads
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.lerobot_compat.pad_features import configured_pads

PADS = {
    "left_arm_left_finger": {"port": "/dev/ttyA", "rows": 16, "pad_rows": 12, "row_offset": 4},
    "left_arm_right_finger": {
        "port": "/dev/ttyB",
        "flip_rows": True,
        "protocol": "binary",
        "baud": 2_000_000,
    },
}


def pads_file(folder: Path) -> None:
    (folder / "pads.yaml").write_bytes(mutants.yaml_text({"pads": PADS}))


def mutated_pads(folder: Path, rng: random.Random) -> str:
    return mutants.written(folder / "pads.yaml", mutants.yaml_mutant(rng, {"pads": PADS}))


@run_cli
def reading_pads(folder: Path) -> None:
    """What the robots and ``vtrefine-view-pads`` do before they open ports."""
    path = folder / "pads.yaml"
    first = configured_pads({}, path)
    second = view_pads.chosen_pads(view_pads.make_parser().parse_args(["--pads_file", str(path)]))
    assert first == second
    for pad in first.values():
        assert np.zeros(pad.pad_shape).size <= 64 * 64
        pad.orientation.apply(np.zeros((pad.rows, pad.cols), np.uint8))


def emulator_flags(rng: random.Random) -> list[str]:
    junk = (
        "0",
        "-1",
        "nan",
        "inf",
        "1e300",
        "1e-300",
        "many",
        "",
        "3000",
        "99999999999999999999",
        "0x10",
        "²",
    )
    folders = (
        "/proc",
        "/proc/self/x",
        "/proc/self/fd",
        "/dev/null",
        "/dev/null/x",
        "",
        "a\udcffb",
        "x" * 5000,
    )
    flags = rng.sample(
        [
            ("--boards", junk),
            ("--rate", junk),
            ("--shape", (*junk, "12x", "0x0", "64x65", "1x1", "999999999x1", "12x32x3", "²x²")),
            ("--seed", junk),
            ("--loss", (*junk, "1", "2")),
            ("--burst_loss", (*junk, "1")),
            ("--stall_every", (*junk, "0.01")),
            ("--stall", junk),
            ("--unplug_at", (*junk, "0.01")),
            ("--replug_after", junk),
            ("--protocol", ("ascii", "diagnostic", "morse")),
            ("--source", ("press", "pattern", "recording", "music")),
            ("--markers", junk),
            ("--folder", folders),
            ("--recording", ("/dev/zero", "/proc/kcore", "/etc/passwd", "/", "nowhere", "")),
            ("--arms", folders),
            ("--nonsense", junk),
        ],
        rng.choice([1, 1, 2]),
    )
    return [f"{name}={rng.choice(values)}" for name, values in flags]


def mutated_flags(folder: Path, rng: random.Random) -> str:
    flags = emulator_flags(rng)
    (folder / "flags.json").write_text(json.dumps(flags))
    return " ".join(flags)


def emulating(folder: Path) -> int:
    flags = json.loads((folder / "flags.json").read_text())
    if not any(flag.startswith("--folder") for flag in flags):
        flags.append(f"--folder={folder / 'ports'}")
    return pad_emulator.main([*flags, "--seconds=0.2"])


def mutated_play(folder: Path, rng: random.Random) -> str:
    frames = np.random.default_rng(0).integers(0, 99, (4, 12, 32), dtype=np.uint8)
    if rng.random() < 0.5:
        flags = [f"--recording={folder / 'play.npy'}"]
        note = mutants.written(folder / "play.npy", mutants.npy_mutant(rng, frames))
    else:
        flags = [f"--recording={folder / 'play.npz'}"]
        note = mutants.written(folder / "play.npz", mutants.npz_mutant(rng, {"frames": frames}))
    (folder / "flags.json").write_text(json.dumps([*flags, "--boards=1"]))
    return note


KINDS = (
    Kind("pads file", pads_file, mutated_pads, reading_pads, 4),
    Kind("emulator flags", None, mutated_flags, emulating, 4),
    Kind("emulator recording", None, mutated_play, emulating, 2),
)
