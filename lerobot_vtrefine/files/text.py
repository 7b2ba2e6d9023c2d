"""Text, JSON, JSON lines, YAML and tables of numbers, with bounds on size and depth that hold before parsing.

Every function raises OSError for a file that is not there or cannot be read, and ValueError, naming the file,
for one that is not what it should be.
"""

import csv
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, override

import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from lerobot_vtrefine.wording import plural

MAX_JSON_BYTES = 8 << 20
MAX_YAML_BYTES = 64 << 10
"""PyYAML takes about a second for this much."""
MAX_LINE_BYTES = 64 << 10
MAX_LINES = 1_000_000
MAX_DEPTH = 32
"""Lists and mappings within each other; no format here has more than eight."""

_JSON_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*+"?|[\[{]|[\]}]', re.DOTALL)


def read_text(path: str | Path, max_bytes: int = MAX_JSON_BYTES) -> str:
    """UTF-8 text of a regular file, without a byte order mark."""
    path = Path(path)
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is not a regular file")
    with path.open("rb") as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise ValueError(f"{path} is larger than the {max_bytes:,} bytes that such a file may have")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 text (byte {error.start})") from error


def read_json(path: str | Path) -> Any:
    """What a JSON file holds; keys must not repeat, numbers must be finite."""
    return _parse_json(str(path), read_text(path))


def read_json_lines(path: str | Path) -> list[Any]:
    """A value for every line that is not empty."""
    return [
        _parse_json(f"{path}, line {number}", line) for number, line in _lines(Path(path)) if line.strip()
    ]


def read_number_rows(path: str | Path) -> list[dict[str, float]]:
    """Rows of a CSV file of numbers below a line of names; empty cells are left out."""
    rows = csv.reader(line for _, line in _lines(Path(path)))
    try:
        names = next(rows, [])
        if len(set(names)) < len(names):
            raise ValueError("a column's name repeats")
        return [_number_row(names, row) for row in rows if row]
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path}, line {rows.line_num}: {error}") from error


def read_yaml(path: str | Path) -> Any:
    """What a YAML file holds: plain values without aliases, tags and repeated keys."""
    text = read_text(path, MAX_YAML_BYTES)
    try:
        return yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{path} is not valid YAML: {_first_line(error)}") from error


def check_settings(path: str | Path) -> None:
    """Refuse a file of settings, YAML or JSON, that another parser would hang on or choke over.

    Aliases (but none within another's value, which is how they explode) and tags are left to that parser.
    """
    if Path(path).suffix == ".json":
        if not isinstance(read_json(path), dict):
            raise ValueError(f"{path} must hold settings by name")
        return
    depth, anchors, root = 0, [], None
    try:
        for event in yaml.parse(read_text(path, MAX_YAML_BYTES), yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent) and anchors:
                raise ValueError(f"{path}: an alias (*) within the value of another (&) is not allowed")
            if isinstance(event, yaml.NodeEvent):
                root = root or event
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
                if event.anchor:
                    anchors.append(depth)
            elif isinstance(event, yaml.CollectionEndEvent):
                anchors = anchors[:-1] if anchors and anchors[-1] == depth else anchors
                depth -= 1
            if depth > MAX_DEPTH:
                raise ValueError(f"{path}: nested more than {MAX_DEPTH} levels deep")
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not valid YAML: {_first_line(error)}") from error
    if not isinstance(root, yaml.MappingStartEvent):
        raise ValueError(f"{path} must hold settings by name")


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is not a regular file")
    with path.open("rb") as file:
        for number in range(1, MAX_LINES + 2):
            line = file.readline(MAX_LINE_BYTES + 1)
            if not line:
                return
            if len(line) > MAX_LINE_BYTES or number > MAX_LINES:
                limit = f"{MAX_LINES:,} lines of {MAX_LINE_BYTES:,} bytes"
                raise ValueError(f"{path}, line {number}: the file is larger than {limit}")
            try:
                yield number, line.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                raise ValueError(f"{path}, line {number} is not UTF-8 text") from error


def _number_row(names: list[str], row: list[str]) -> dict[str, float]:
    if len(row) != len(names):
        raise ValueError(f"{plural(len(row), 'value')} for {plural(len(names), 'column')}")
    return {name: float(value) for name, value in zip(names, row, strict=True) if value}


def _parse_json(where: str, text: str) -> Any:
    depth = 0
    for token in _JSON_TOKEN.finditer(text):
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(token[0], 0)
        if depth > MAX_DEPTH:
            raise ValueError(f"{where}: nested more than {MAX_DEPTH} levels deep")
    try:
        return json.loads(
            text, object_pairs_hook=_distinct, parse_constant=_finite, parse_float=_finite, parse_int=_whole
        )
    except json.JSONDecodeError as error:
        raise ValueError(f"{where}: not valid JSON ({error})") from error
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)[:60]!r} is given twice")
    return content


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:40]} is not a finite number")
    return number


def _whole(text: str) -> int:
    if len(text) > 40:
        raise ValueError(f"{text[:20]}... is too large a number")
    return int(text)


def _first_line(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    where = f" in line {mark.line + 1}" if mark is not None else ""
    problem = getattr(error, "problem", None) or str(error) or type(error).__name__
    return f"{problem.splitlines()[0][:200]}{where}"


class _PlainLoader(yaml.SafeLoader):
    """Values alone: no aliases, which expand, no tags, no repeated keys, no more than `MAX_DEPTH` levels."""

    depth = 0

    @override
    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        problem = None
        if self.check_event(yaml.AliasEvent) or getattr(event, "anchor", None):
            problem = "aliases (* and &) are not allowed"
        elif getattr(event, "tag", None):
            problem = "tags (!) are not allowed"
        elif self.depth >= MAX_DEPTH:
            problem = f"nested more than {MAX_DEPTH} levels deep"
        if problem is not None:
            raise ComposerError(None, None, problem, event.start_mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    @override
    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else None
            if name is None or name in seen:
                problem = "a key must be a word" if name is None else f"{name[:60]!r} is given twice"
                raise ConstructorError(None, None, problem, key.start_mark)
            seen.add(name)
        return super().construct_mapping(node, deep)
