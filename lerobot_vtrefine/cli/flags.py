"""Flags of commands as their dataclasses declare them, read from the source so that nothing is imported.

LeRobot and PyTorch take ten seconds to import, and showing a command's help needs neither.
"""

import ast
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
ROOT = "lerobot_vtrefine"
STAND_INS = {"EnvConfig": ("lerobot_vtrefine.envs.config", "VtRefineEnvConfig")}
"""Classes of LeRobot's for which commands take one of ours."""


@dataclass(frozen=True)
class Flag:
    """One flag: its dotted name, type and default as they are written, and what it is for.

    ``group`` is the (module, class) whose fields are flags below this one, None for a single value. A flag
    without a default is ``required``.
    """

    name: str
    type: str
    default: str | None
    text: str
    required: bool
    group: tuple[str, str] | None = None

    @property
    def is_list(self) -> bool:
        """Whether it takes ``[a, b]``."""
        return self.type.startswith(("list[", "["))

    @property
    def has_flags_below(self) -> bool:
        """Whether it takes no value itself: a class of ours, or one of LeRobot's, has its flags."""
        return self.group is not None or self.type.endswith("Config")

    def is_among(self, given: Iterable[str]) -> bool:
        """Whether one of these names is the flag's, or lies below it."""
        return any(name == self.name or name.startswith(f"{self.name}.") for name in given)


def describe_module(module: str) -> tuple[str, str]:
    """The sentence of ```` ``command``: sentence ```` that opens a module's docstring, and the rest of it."""
    first, _, rest = (ast.get_docstring(_tree(module)) or "").partition("\n\n")
    sentence = " ".join(first.split()).partition(": ")[2]
    return sentence[:1].upper() + sentence[1:], rest.replace("::\n", ":\n").strip()


def flags_of(
    module: str, name: str, prefix: str = "", *, nested: bool = False, unused: bool = False
) -> list[Flag]:
    """The fields of a dataclass as flags.

    Args:
        nested: also those of the dataclasses that it holds.
        unused: also those that a command takes and does nothing with.
    """
    found = []
    for flag in _fields(module, name, prefix):
        if flag.text.startswith("Unused") and not unused:
            continue
        found.append(flag)
        if nested and flag.group is not None:
            found += flags_of(*flag.group, f"{flag.name}.", nested=True)
    return found


def _fields(module: str, name: str, prefix: str) -> Iterator[Flag]:
    node = next(n for n in _tree(module).body if isinstance(n, ast.ClassDef) and n.name == name)
    lines = _path(module).read_text(encoding="utf-8").splitlines()
    for base in node.bases:
        inherited = ast.unparse(base)
        place = None if inherited in STAND_INS else _defined_in(module, inherited)
        if place is not None:
            yield from _fields(*place, prefix)
    for entry, following in zip(node.body, [*node.body[1:], None], strict=True):
        if not isinstance(entry, ast.AnnAssign) or not isinstance(entry.target, ast.Name):
            continue
        kind = ast.unparse(entry.annotation)
        if kind.startswith("ClassVar"):
            continue
        text = _docstring(following) or _comment(lines, entry.lineno - 1)
        group = _defined_in(module, kind.removesuffix(" | None"))
        default = None if group is not None and entry.value is not None else _default(entry.value)
        name = prefix + entry.target.id
        yield Flag(name, _kind(kind), default, text, entry.value is None, group)


def _docstring(node: ast.stmt | None) -> str:
    if (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    ):
        return " ".join(node.value.value.split())
    return ""


def _comment(lines: list[str], index: int) -> str:
    above = []
    while index > 0 and lines[index - 1].strip().startswith("#"):
        index -= 1
        above.insert(0, lines[index].strip().removeprefix("#").strip())
    return " ".join(above)


def _kind(annotation: str) -> str:
    """A type as users write its values: ``list[int]`` for any number of them, ``[int, int]`` for two."""
    kind = annotation.removesuffix(" | None")
    if not kind.startswith("tuple["):
        return kind
    items = kind.removeprefix("tuple")
    return f"list{items.replace(', ...', '')}" if items.endswith(", ...]") else items


def _default(value: ast.expr | None) -> str | None:
    """A default as a user would type it; empty for what only code can say, None for no default."""
    if value is None:
        return None
    if isinstance(value, ast.Call) and ast.unparse(value.func) == "Path" and value.args:
        value = value.args[0]
    try:
        literal = ast.literal_eval(value)
    except ValueError:
        return ""
    if isinstance(literal, tuple | list):
        return f"[{', '.join(map(str, literal))}]"
    return "" if literal is None else str(literal).lower() if isinstance(literal, bool) else str(literal)


def _defined_in(module: str, name: str) -> tuple[str, str] | None:
    """Where the dataclass that a module calls ``name`` is written; None for anything else than ours."""
    if name in STAND_INS:
        return STAND_INS[name]
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.ClassDef) and node.name == name:
            return (module, name) if any("dataclass" in ast.unparse(d) for d in node.decorator_list) else None
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(ROOT):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return _defined_in(str(node.module), alias.name)
    return None


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(_path(module).read_text(encoding="utf-8"))


def _path(module: str) -> Path:
    path = PACKAGE.joinpath(*module.split(".")[1:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
