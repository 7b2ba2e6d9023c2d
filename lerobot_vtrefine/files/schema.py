"""One schema per file: a dataclass, whose annotations and limits a file's content must meet."""

import dataclasses
import math
from collections.abc import Mapping
from difflib import get_close_matches
from functools import lru_cache
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

LARGEST_NUMBER = 1e15
"""No number of any format is larger, whatever its unit."""
LONGEST_TEXT = 4096
_SHOWN = 60

Limits = Mapping[str, Any]


def limits(
    minimum: float | None = None,
    maximum: float | None = None,
    above: float | None = None,
    **default: Any,
) -> Any:
    """Dataclass field whose numbers, in lists and mappings too, keep to limits; `default` as for `field`."""
    ends = {"minimum": minimum, "maximum": maximum, "above": above}
    return dataclasses.field(metadata=ends, **default)


def decode[Kind](kind: type[Kind], data: Any, name: str, prefix: str = "", others: bool = False) -> Kind:
    """A dataclass made of plain data: mappings, lists, texts, numbers, true, false, null.

    Fields are checked by their annotation (bool, int, float, str, Literal, tuples, lists of anything,
    mappings by text, dataclasses, and unions of these) and by the `limits` in their metadata.

    Args:
        name: what the data are, for messages about their fields.
        prefix: what stands before a field's name in messages about its value.
        others: let fields pass that the dataclass does not have; they are left out. For formats of others,
            and for files whose writers add notes of their own. What is nearly a missing field's name is
            still refused.

    Raises:
        ValueError: names the field and what is wrong with it, or the fields that there are.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"{name} must be an object, got {_shown(data)}")
    hints, fields = _hints(kind), {item.name: item for item in dataclasses.fields(kind) if item.init}  # ty: ignore[invalid-argument-type]
    absent = [key for key in fields if key not in data]
    for key in data:
        if key in fields:
            continue
        if not others:
            raise ValueError(f"{name} has no {_shown(key)}; valid: {', '.join(fields) or 'none'}")
        if meant := get_close_matches(str(key)[:_SHOWN], absent, n=1, cutoff=0.8):
            raise ValueError(f"{name} has no {_shown(key)}; is {meant[0]!r} meant?")
    values = {}
    for key, item in fields.items():
        if key in data:
            values[key] = _value(hints[key], data[key], f"{prefix}{key}", item.metadata, others)
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            raise ValueError(f"{name} lacks {key!r}")
    return kind(**values)


@lru_cache(maxsize=128)
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _shown(value: Any) -> str:
    text = repr(value) if isinstance(value, str | int | float | NoneType) else f"a {type(value).__name__}"
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _value(kind: Any, value: Any, where: str, ends: Limits, others: bool) -> Any:
    """The value as its annotation wants it."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any or (kind is object):
        return value
    if origin in (Union, UnionType):
        fitting = [part for part in parts if _fits(part, value)]
        if not fitting:
            raise ValueError(f"{where} must be {' or '.join(map(_word, parts))}, got {_shown(value)}")
        return _value(fitting[0], value, where, ends, others)
    if not _fits(kind, value):
        raise ValueError(f"{where} must be {_word(kind)}, got {_shown(value)}")
    if kind in (int, float):
        return _number(kind, value, where, ends)
    if kind is str and len(value) > LONGEST_TEXT:
        raise ValueError(f"{where} must not have more than {LONGEST_TEXT} characters, got {len(value)}")
    if kind is str and not value.isprintable():
        raise ValueError(f"{where} must be printable, got {value[:_SHOWN]!a}")
    if origin is tuple:
        return _items(parts, value, where, ends, others)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {
            key: _value(parts[1], item, f"{where}.{key[:_SHOWN]}", ends, others)
            for key, item in value.items()
        }
    if dataclasses.is_dataclass(kind):
        return decode(kind, value, where, f"{where}.", others)
    return value


def _fits(kind: Any, value: Any) -> bool:
    """Whether a value is of an annotation's sort, whatever it holds."""
    origin = get_origin(kind)
    if kind in (int, float):
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind in (bool, str, NoneType):
        return isinstance(value, kind)
    if origin is Literal:
        return isinstance(value, str) and value in get_args(kind)
    if origin is tuple:
        return isinstance(value, list | tuple)
    if origin is list:
        return isinstance(value, list)
    if (isinstance(origin, type) and issubclass(origin, Mapping)) or dataclasses.is_dataclass(kind):
        return isinstance(value, Mapping) and all(isinstance(key, str) for key in value)
    raise TypeError(f"no schema can hold {kind}")


def _word(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return f"one of {', '.join(get_args(kind))}"
    words = {int: "a whole number", float: "a number", str: "a text", bool: "true or false", NoneType: "null"}
    return words.get(kind, "a list" if get_origin(kind) in (tuple, list) else "an object")


def _items(parts: tuple[Any, ...], value: Any, where: str, ends: Limits, others: bool) -> tuple[Any, ...]:
    if len(parts) == 2 and parts[1] is Ellipsis:
        parts = (parts[0],) * len(value)
    if len(parts) != len(value):
        raise ValueError(f"{where} must hold {len(parts)} values, got {len(value)}")
    return tuple(
        _value(part, item, f"{where}[{index}]", ends, others)
        for index, (part, item) in enumerate(zip(parts, value, strict=True))
    )


def _number(kind: type, value: float, where: str, ends: Limits) -> float | int:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{where} must be a finite number, got {value}")
    if kind is int and value != int(value):
        raise ValueError(f"{where} must be a whole number, got {value}")
    low, high, above = ends.get("minimum"), ends.get("maximum"), ends.get("above")
    if above is not None and not value > above:
        raise ValueError(f"{where} must be above {above:g}, got {_shown(value)}")
    if low is not None and value < low:
        least = "must not be negative" if low == 0 else f"must be at least {low:g}"
        raise ValueError(f"{where} {least}, got {_shown(value)}")
    high = LARGEST_NUMBER if high is None else high
    if value > high or (low is None and above is None and value < -high):
        raise ValueError(f"{where} must be at most {high:g}, got {_shown(value)}")
    return kind(value)
