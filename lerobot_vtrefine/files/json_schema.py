"""JSON Schema (draft 2020-12) of a file's dataclass: what `decode` checks, for programs that are not ours."""

import dataclasses
from collections.abc import Mapping
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from lerobot_vtrefine.files.schema import LONGEST_TEXT

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_PLAIN: dict[Any, dict[str, Any]] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string", "maxLength": LONGEST_TEXT},
    NoneType: {"type": "null"},
    Any: {},
    object: {},
}


def json_schema(kind: type, others: bool = False) -> dict[str, Any]:
    """The JSON Schema of a dataclass, without the dialect's name.

    Args:
        others: whether fields that the dataclass does not have may be there, as for `decode`.
    """
    hints = get_type_hints(kind)
    fields = [item for item in dataclasses.fields(kind) if item.init]  # ty: ignore[invalid-argument-type]
    required = [
        item.name
        for item in fields
        if item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING
    ]
    found: dict[str, Any] = {
        "type": "object",
        "properties": {item.name: _of(hints[item.name], item.metadata, others) for item in fields},
        "required": required,
    }
    return found if others else found | {"additionalProperties": False}


def _of(kind: Any, ends: Mapping[str, Any], others: bool) -> dict[str, Any]:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return {"anyOf": [_of(part, ends, others) for part in parts]}
    if origin is Literal:
        return {"enum": list(parts)} if len(parts) > 1 else {"const": parts[0]}
    if origin is tuple:
        return _array(parts, ends, others)
    if origin is list or kind is list:
        return {"type": "array"}
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": _of(parts[1], ends, others)}
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return json_schema(kind, others)
    if kind in (int, float):
        return _PLAIN[kind] | _limits(ends)
    return dict(_PLAIN[kind])


def _array(parts: tuple[Any, ...], ends: Mapping[str, Any], others: bool) -> dict[str, Any]:
    if len(parts) == 2 and parts[1] is Ellipsis:
        return {"type": "array", "items": _of(parts[0], ends, others)}
    items = [_of(part, ends, others) for part in parts]
    return {"type": "array", "prefixItems": items, "minItems": len(items), "maxItems": len(items)}


def _limits(ends: Mapping[str, Any]) -> dict[str, Any]:
    names = {"minimum": "minimum", "maximum": "maximum", "above": "exclusiveMinimum"}
    found = {word: ends[name] for name, word in names.items() if ends.get(name) is not None}
    # What has only an upper end keeps to it on either side of zero.
    return {"minimum": -found["maximum"], **found} if set(found) == {"maximum"} else found
