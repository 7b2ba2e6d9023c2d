"""What a dataset's card says of its simulation: settings, seeds, outcomes, from ``meta/recording.json``."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.files import read_json

NOTE = Path("meta") / "recording.json"
"""The simulation's settings, and each episode's seed and outcome, beside a simulated dataset."""
MEASURED = (
    ("time_to_success_s", "time to success", 1.0, "s"),
    ("in_hand_shift_m", "in-hand shift", 1e3, "mm"),
    ("peak_force_n", "peak contact force", 1.0, "N"),
)


def describe_simulation(root: Path) -> str:
    """Markdown about the simulation that the dataset at ``root`` comes from; empty where it notes none."""
    note = read_json(root / NOTE) if (root / NOTE).is_file() else None
    if not isinstance(note, Mapping) or not isinstance(note.get("settings"), Mapping):
        return ""
    rows = [row for row in note.get("episodes", ()) if isinstance(row, Mapping)]
    parts = (_where(note["settings"]), _who(note, rows), _outcomes(rows))
    return "\n\n".join(["### Simulation", *(part for part in parts if part)])


def _where(settings: Mapping[str, Any]) -> str:
    scene = settings.get("scene", {})
    hidden = ", with physics that are kept hidden" if "reality" in settings else ""
    ablated = f", with `--env.ablate={settings['ablate']}`" if "ablate" in settings else ""
    return (
        f"Recorded in the simulation of `lerobot_vtrefine`, not on a robot{hidden}{ablated}: pair "
        f"`{scene.get('pair')}`, clearance {1e3 * float(scene.get('clearance_m') or 0):g} mm, "
        f"start `{scene.get('start')}`, sensor model `{settings.get('sensor_model')}`. `{NOTE.as_posix()}` "
        "holds every setting, and every "
        "episode's seed and outcome."
    )


def _who(note: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """The scripted expert and its attempts; nothing where a person or a policy acted."""
    settings = note["settings"]
    if "degradation" not in settings:
        return ""
    first, attempts = int(settings["seed"]), int(note["next_seed"]) - int(settings["seed"])
    errors = ", ".join(f"`{name}` {value:g}" for name, value in settings["degradation"].items() if value)
    kept = (
        "all were kept" if settings.get("include_failures") else f"the {len(rows)} that succeeded were kept"
    )
    return (
        f"A scripted expert acted, with {f'errors ({errors})' if errors else 'no errors'}, in {attempts} "
        f"attempts with environment seeds {first} to {first + attempts - 1}; {kept}."
    )


def _outcomes(rows: Sequence[Mapping[str, Any]]) -> str:
    lines = ["| of the episodes here | median | 90 % lie below |", "|---|---|---|"]
    for key, words, scale, unit in MEASURED:
        values = [scale * row[key] for row in rows if isinstance(row.get(key), int | float)]
        if values:
            middle, high = np.quantile(values, [0.5, 0.9])
            lines.append(f"| {words} | {middle:.1f} {unit} | {high:.1f} {unit} |")
    successes = sum(bool(row.get("success")) for row in rows)
    return "\n".join(lines) + f"\n\n{successes} of {len(rows)} episodes end in success." if rows else ""
