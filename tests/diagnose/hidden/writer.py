"""Sessions to disk in the contract's format; what is true about them stays with the caller."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hidden.session import Recording, Session, Spec, run_session


@dataclass(frozen=True)
class Truth:
    """What a verdict is held against. Never written beside the recordings."""

    spec: Spec
    seed: int
    causes: tuple[str, ...]
    """Names of the causes at work, those outside the list left out."""
    outside: bool
    params: dict[str, dict[str, float]] = field(default_factory=dict)
    """Cause -> parameters, where the effect has the contract's form."""

    @property
    def status(self) -> str:
        return "unexplained" if self.outside else "explained" if self.causes else "adequate"


def columns(recording: Recording, drive: str, with_temperature: bool) -> dict[str, pa.Array]:
    """The columns of a trial's Parquet file."""
    table = {"time_s": pa.array(recording.time_s)}
    for name, values in zip(("x_m", "y_m", "depth_m"), recording.position_m.T, strict=True):
        table[name] = pa.array(values)
    if drive == "force":
        del table["depth_m"]
    if drive != "depth":
        table["force_n"] = pa.array(recording.force_n)
    if with_temperature:
        table["temperature_c"] = pa.array(recording.temperature_c)
    table["raw"] = pa.array(list(recording.raw.astype(np.float64)), type=pa.list_(pa.float64()))
    return table


def write_session(path: Path, session: Session) -> None:
    """recording.json and one Parquet file per trial, in the order in which they were recorded."""
    path.mkdir(parents=True, exist_ok=True)
    rig = session.rig
    warm = any(e.form in ("temperature", "thermal_gain") for e in session.effects)
    trials = []
    for i, recording in enumerate(sorted(session.recordings, key=lambda r: r.order)):
        name = f"trial_{i:04d}.parquet"
        pq.write_table(pa.table(columns(recording, rig.drive, warm)), path / name)
        trials.append(
            {
                "file": name,
                "condition": f"c{recording.condition:02d}",
                "replicate": recording.replicate,
                "order": recording.order,
                "start_s": recording.start_s,
                "object": rig.indenters[recording.motion.indenter].as_json(),
            }
        )
    head = {
        "schema": "vtrefine/recording-set@1",
        "kind": "pad",
        "pad": {"rows": rig.rows, "cols": rig.cols, "pitch_m": rig.pitch_m},
        "reading": {"unit": "adc_counts", "full_scale": rig.full_scale},
        "object": rig.indenters[0].as_json(),
        "trials": trials,
    }
    (path / "recording.json").write_text(json.dumps(head, indent=1), encoding="utf-8")


def truth_of(session: Session, seed: int) -> Truth:
    effects = session.effects
    return Truth(
        session.spec,
        seed,
        tuple(e.family for e in effects if e.family != "outside"),
        any(e.family == "outside" for e in effects),
        {e.family: e.params for e in effects if e.params},
    )


def write_set(path: Path, spec: Spec, seed: int, locked: Path | None = None) -> Truth:
    """Write the recordings of a specification, and six more of the same pad to `locked` if given."""
    session, later = run_session(spec, seed, locked=6 if locked else 0)
    write_session(path, session)
    if locked:
        write_session(locked, later)
    if spec.corruption:
        from hidden.corrupt import CORRUPTIONS

        CORRUPTIONS[spec.corruption](path)
    return truth_of(session, seed)
