"""The sensor model: an ordered list of stages from contact to raw counts, in one JSON file."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lerobot_vtrefine.tactile.stages  # noqa: F401  registers every stage
from lerobot_vtrefine.files import decode, read_json
from lerobot_vtrefine.tactile.stages.base import DOMAINS, STAGES, Stage, stage_class
from lerobot_vtrefine.tactile.stages.contact import Consistent, ContactStage, KelvinVoigt
from lerobot_vtrefine.tactile.stages.cover import on_springs
from lerobot_vtrefine.tactile.stages.dividers import RowSharing
from lerobot_vtrefine.tactile.stages.hysteresis import without_loop
from lerobot_vtrefine.tactile.stages.readout import Gain, Idle, Noise, Quantisation

SCHEMA = "vtrefine/sensor-model@1"
NAMED = ("default", "paper")


@dataclass(frozen=True)
class SensorModel:
    """Stages in the order in which they act; exactly one contact stage and one gain.

    Raises ValueError when a stage repeats or the domains are out of order (depth, contact, force, gain,
    counts).
    """

    stages: tuple[Stage, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "stages", tuple(self.stages))
        names = [stage.name for stage in self.stages]
        if len(set(names)) != len(names):
            raise ValueError(f"sensor model repeats a stage: {', '.join(names)}")
        for domain in ("contact", "gain"):
            found = [stage.name for stage in self.stages if stage.domain == domain]
            if len(found) != 1:
                valid = sorted(name for name, cls in STAGES.items() if cls.domain == domain)
                raise ValueError(
                    f"sensor model needs exactly one {domain} stage ({', '.join(valid)}), got {found}"
                )
        order = [DOMAINS.index(stage.domain) for stage in self.stages]
        if order != sorted(order):
            raise ValueError(
                f"sensor model stages must go from {' to '.join(DOMAINS)}, got {', '.join(names)}"
            )

    @classmethod
    def default(cls) -> "SensorModel":
        """The simulator's model: load-consistent contact, gain, the row's divider, idle level, noise, 8-bit
        converter.

        20 N spread over 100 taxels reads about 75 counts above an idle level of 10 to 40.
        """
        return cls((Consistent(), Gain(), RowSharing(), Idle(), Noise(), Quantisation()))

    @classmethod
    def paper(cls) -> "SensorModel":
        """The paper's model with its printed constants (k_n = 1, k_d = 3e-3), rescaled so that 1 mm fills 8
        bits."""
        return cls((KelvinVoigt(k_n=1.0, k_d=3e-3), Gain(counts_per_n=255e3), Quantisation()))

    @classmethod
    def named(cls, name: str) -> "SensorModel":
        """ "default", "paper", or the path of a sensor_model.json."""
        if name == "default":
            return cls.default()
        if name == "paper":
            return cls.paper()
        if not Path(name).is_file():
            raise FileNotFoundError(f"sensor model {name!r} is neither a file nor one of {', '.join(NAMED)}")
        return cls.load(name)

    @property
    def has_state(self) -> bool:
        """Whether frames must be processed in order, each once."""
        return any(stage.has_state for stage in self.stages)

    @property
    def parts_forces(self) -> bool:
        """Whether a stage must know which part of the contact's force damping bears."""
        return any(on_springs(stage) for stage in self.stages)

    @property
    def contact(self) -> ContactStage:
        """The contact stage."""
        return next(stage for stage in self.stages if isinstance(stage, ContactStage))

    @property
    def depth_stages(self) -> tuple[Stage, ...]:
        """Stages before the contact law."""
        return tuple(stage for stage in self.stages if stage.domain == "depth")

    @property
    def force_stages(self) -> tuple[Stage, ...]:
        """Stages after the contact law: force, gain and counts."""
        return tuple(stage for stage in self.stages if stage.domain not in ("depth", "contact"))

    def find(self, name: str) -> Stage | None:
        """The stage of that name, or None; ValueError for a name that no stage has."""
        stage_class(name)
        return next((stage for stage in self.stages if stage.name == name), None)

    def with_stage(self, stage: Stage) -> "SensorModel":
        """With the stage put at its canonical place, or in place of the one of the same name (or domain, if
        unique)."""
        for index, present in enumerate(self.stages):
            unique = stage.domain == present.domain and stage.domain in ("contact", "gain")
            if present.name == stage.name or unique:
                return SensorModel((*self.stages[:index], stage, *self.stages[index + 1 :]))
        after = sum(present.rank <= stage.rank for present in self.stages)
        return SensorModel((*self.stages[:after], stage, *self.stages[after:]))

    def without(self, *names: str) -> "SensorModel":
        """Without the stages of those names."""
        for name in names:
            stage_class(name)
        return SensorModel(tuple(stage for stage in self.stages if stage.name not in names))

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Range for randomisation of every parameter that has one: "stage.parameter" -> (low, high)."""
        return {
            f"{stage.name}.{item.name}": item.metadata["range"]
            for stage in self.stages
            for item in dataclasses.fields(stage)
            if "range" in item.metadata
        }

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form."""
        stages = [{"stage": stage.name, **dataclasses.asdict(stage)} for stage in self.stages]
        return {"schema": SCHEMA, "stages": stages}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "SensorModel":
        """Inverse of `to_dict`; ValueError names the stage or parameter that is unknown, and the valid
        ones."""
        if (
            not isinstance(data, dict)
            or data.get("schema") != SCHEMA
            or not isinstance(data.get("stages"), list)
        ):
            raise ValueError(f'sensor model must hold "schema": "{SCHEMA}" and a list "stages"')
        if others := sorted(set(data) - {"schema", "stages"}):
            raise ValueError(f"sensor model has no {others[0][:60]!r}; valid: schema, stages")
        return cls(tuple(_stage_from_dict(item) for item in data["stages"]))

    def save(self, path: str | Path) -> None:
        """Write sensor_model.json."""
        Path(path).write_text(json.dumps(self.to_dict(), indent=2) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "SensorModel":
        """Read sensor_model.json; ValueError names the file and what is wrong with it."""
        data = read_json(path)
        try:
            return cls.from_dict(data)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def _stage_from_dict(item: Any) -> Stage:
    if not isinstance(item, dict) or not isinstance(item.get("stage"), str):
        raise ValueError(f'every stage needs a "stage" name; valid names: {", ".join(sorted(STAGES))}')
    item = without_loop(item)
    cls = stage_class(item["stage"])
    parameters = {key: value for key, value in item.items() if key != "stage"}
    return decode(cls, parameters, f"stage {cls.name!r}", f"{cls.name}.")
