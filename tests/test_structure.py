"""Countable rules of the code base: layers, sizes, typed signatures, nothing machine-specific."""

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Generator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "lerobot_vtrefine"
SOURCES = sorted(PACKAGE.rglob("*.py"))

# A package imports only from its own layer's packages above it; those on one line do not import each other.
LAYERS = (
    ("files",),
    ("pages",),
    ("tactile",),
    ("embodiments",),
    ("observation",),
    ("datasets",),
    ("drivers",),
    ("lerobot_compat",),
    ("sim",),
    ("envs",),
    ("view",),
    ("robots", "teleoperators", "cameras"),
    ("policies",),
    ("finetune", "information"),
    ("diagnose",),
    ("cli",),
)
RANK = {package: rank for rank, packages in enumerate(LAYERS) for package in packages}
FORBIDDEN = {"sim": ("lerobot", "gymnasium"), "tactile": ("lerobot", "mujoco"), "embodiments": ("mujoco",)}
FORBIDDEN_WITHIN = {"diagnose": ("policies", "finetune")}

MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 60
STARTING = {f"subprocess.{name}" for name in ("run", "call", "check_call", "check_output", "Popen")}
LONG_FUNCTIONS_ALLOWED = ("lerobot_vtrefine/finetune/dppo.py",)  # the training loop reads best in one piece


@pytest.fixture(scope="module", autouse=True)
def _trees_go() -> Generator[None]:
    """A million objects that the garbage collector would look through in the tests of other files."""
    yield
    tree_of.cache_clear()


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imported_modules(tree: ast.AST) -> list[str]:
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names.append(node.module or "")
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def layer_of(path: Path) -> str | None:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 and not parts[0].startswith("_") else None


def layer_violations(layer: str, modules: list[str]) -> list[str]:
    """Names among ``modules`` that code of ``layer`` must not import."""
    wrong = []
    for module in modules:
        top, _, rest = module.partition(".")
        if top != "lerobot_vtrefine":
            wrong += [module] if top in FORBIDDEN.get(layer, ()) else []
            continue
        target = rest.split(".")[0]
        if target in RANK and target != layer and RANK[target] >= RANK[layer]:
            wrong.append(module)
        wrong += [module] if target in FORBIDDEN_WITHIN.get(layer, ()) else []
    return wrong


def functions_of(tree: ast.AST) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_layer_rule_is_strict() -> None:
    assert layer_violations("sim", ["lerobot_vtrefine.envs.config"])
    assert layer_violations("sim", ["lerobot.policies"])
    assert layer_violations("robots", ["lerobot_vtrefine.cameras"])
    assert layer_violations("diagnose", ["lerobot_vtrefine.policies.vt_dp3"])
    assert not layer_violations("sim", ["lerobot_vtrefine.tactile", "lerobot_vtrefine.sim.pairs", "mujoco"])


def test_packages_import_only_from_layers_above() -> None:
    wrong = {
        relative(path): bad
        for path in SOURCES
        if (layer := layer_of(path)) and (bad := layer_violations(layer, imported_modules(tree_of(path))))
    }
    assert wrong == {}


def test_every_package_has_a_layer() -> None:
    unknown = {layer for path in SOURCES if (layer := layer_of(path)) and layer not in RANK}
    assert unknown == set()


# Imports that point back, inside functions; without these, no module needs itself by way of others.
BACK = {
    # LeRobot asks a configuration for its environments.
    "envs.config": {"envs.vectorization"},
    # Whether a name is a cause is asked of the catalogues, which hold causes of one's own, too.
    "diagnose.verdict": {f"diagnose.{kind}.candidates" for kind in ("joints", "pad", "servo")},
    "diagnose.pad.press_trials": {"diagnose.pad.forward_model.run"},
    "diagnose.pad.problem": {"diagnose.pad.review"},
}


def without_type_imports(tree: ast.Module) -> ast.Module:
    """The tree without ``if TYPE_CHECKING:`` blocks, which import nothing when the program runs."""
    kept = [node for node in tree.body if not (isinstance(node, ast.If) and is_type_checking(node.test))]
    return ast.Module(kept, tree.type_ignores)


def is_type_checking(test: ast.expr) -> bool:
    return isinstance(test, ast.Name) and test.id == "TYPE_CHECKING"


def module_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def needed_modules(tree: ast.AST, known: set[str]) -> set[str]:
    """Modules among ``known`` that a file imports; of ``from package import module`` the module alone."""
    needed = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            package = (node.module or "").removeprefix("lerobot_vtrefine").removeprefix(".")
            inside = {f"{package}.{alias.name}".removeprefix(".") for alias in node.names}
            needed |= (inside & known) or {package}
    return needed & known


def import_circle(imports: Mapping[str, set[str]]) -> list[str]:
    """Modules that import one another in a ring; empty where there is none."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_circle_is_found() -> None:
    assert import_circle({"a": {"b"}, "b": {"c"}, "c": {"a"}})
    assert not import_circle({"a": {"b", "c"}, "b": {"c"}})


def test_imports_make_no_circle() -> None:
    known = {module_of(path) for path in SOURCES}
    imports = {
        module_of(path): needed_modules(without_type_imports(tree_of(path)), known) for path in SOURCES
    }
    rest = {module: needed - BACK.get(module, set()) - {module} for module, needed in imports.items()}
    assert import_circle(rest) == []


def test_contributors_are_told_the_same_layers() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    listed = text.partition("checks it:")[2].partition(".\n")[0]
    told = tuple(tuple(re.findall(r"`(\w+)`", part)) for part in listed.split(","))
    assert told == LAYERS


def test_files_are_short() -> None:
    lengths = {relative(path): len(path.read_text(encoding="utf-8").splitlines()) for path in SOURCES}
    assert {path: lines for path, lines in lengths.items() if lines > MAX_FILE_LINES} == {}


def test_functions_are_short() -> None:
    long = {
        f"{relative(path)}:{node.name}": node.end_lineno - node.lineno + 1
        for path in SOURCES
        if relative(path) not in LONG_FUNCTIONS_ALLOWED
        for node in functions_of(tree_of(path))
        if node.end_lineno is not None and node.end_lineno - node.lineno + 1 > MAX_FUNCTION_LINES
    }
    assert long == {}


def untyped(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    arguments += [argument for argument in (node.args.vararg, node.args.kwarg) if argument]
    missing = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
    return missing + (["return"] if node.returns is None else [])


def is_warp_kernel(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Warp kernels return nothing, and Warp functions infer what they return."""
    return any(ast.unparse(decorator).startswith("wp.") for decorator in node.decorator_list)


def test_signatures_are_typed() -> None:
    missing = {
        f"{relative(path)}:{node.name}": names
        for path in SOURCES
        for node in functions_of(tree_of(path))
        if (names := untyped(node)) and not (is_warp_kernel(node) and names == ["return"])
    }
    assert missing == {}


def test_library_does_not_print() -> None:
    printing = [
        f"{relative(path)}:{node.lineno}"
        for path in SOURCES
        if layer_of(path) != "cli"
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert printing == []


def test_scripts_start_commands_that_end_with_them() -> None:
    """``runs.side_by_side`` and ``own_sessions`` see to it; what subprocess starts goes on without them."""
    starting = [
        f"{relative(path)}:{node.lineno}"
        for path in sorted((ROOT / "scripts").rglob("*.py"))
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in STARTING
    ]
    assert starting == []


def test_no_bare_except_and_no_grab_bag_modules() -> None:
    bare = [
        f"{relative(path)}:{node.lineno}"
        for path in SOURCES
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.ExceptHandler) and node.type is None
    ]
    assert bare == []
    assert [relative(path) for path in SOURCES if path.stem in ("utils", "util", "helpers", "misc")] == []


# Assembled from pieces, so that this file does not contain what it forbids.
MACHINE_SPECIFIC = re.compile(
    "|".join(
        [
            r"(?<![\w.])/" + r"(?:work|root|home|Users)/\w",
            r"\bpypi\." + "org",
            r"\bpython" + r"hosted\.",
            r"download\.py" + "torch",
            r"\bartifact" + "ory",
            r"\bconda\.an" + "aconda",
        ]
    )
)


def test_files_of_tests_have_names_of_their_own() -> None:
    """Where folders are no packages, pytest takes a second module of a name for the first."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert sorted({name for name in names if names.count(name) > 1}) == []


@pytest.mark.parametrize("text", ["/" + "home/me/x", "see /" + "work/x", "https://py" + "pi.org/simple"])
def test_machine_specific_pattern_finds(text: str) -> None:
    assert MACHINE_SPECIFIC.search(text)


def tracked_text_files() -> list[Path]:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listing.returncode:
        pytest.skip("not a git checkout")
    paths = [ROOT / name for name in listing.stdout.decode().split("\0") if name]
    return [path for path in paths if path.is_file() and b"\0" not in path.read_bytes()[:8192]]


def test_nothing_machine_specific_is_tracked() -> None:
    found = [
        f"{relative(path)}:{number}"
        for path in tracked_text_files()
        for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1)
        if MACHINE_SPECIFIC.search(line)
    ]
    assert found == []


def test_nothing_large_is_tracked() -> None:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listing.returncode:
        pytest.skip("not a git checkout")
    paths = [ROOT / name for name in listing.stdout.decode().split("\0") if name]
    assert [relative(path) for path in paths if path.is_file() and path.stat().st_size > 5_000_000] == []


@pytest.mark.parametrize("arguments", [["format", "--check"], ["check"]])
def test_ruff(arguments: list[str]) -> None:
    ruff = shutil.which("ruff", path=str(Path(sys.executable).parent))
    if ruff is None:
        pytest.skip("ruff is not installed; pip install 'lerobot_policy_vtrefine[dev]'")
    result = subprocess.run(
        [ruff, *arguments, "--quiet", str(ROOT)], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout


# The same inside the diagnosis: a room (a folder or a file of its own) imports only from rooms above it.
DIAGNOSE_LAYERS = (
    ("verdict", "evidence", "recordings"),
    ("core",),
    ("joints", "camera", "servo", "pad"),
    ("quality", "report", "episode_replay"),
    ("parts", "calibration"),
    ("dataset",),
    ("api", "predict", "formats", "template"),
    ("stability",),
)
DIAGNOSE_RANK = {room: rank for rank, rooms in enumerate(DIAGNOSE_LAYERS) for room in rooms}
# Causes of one's own are asked for in the catalogues, where a name is not among the listed ones.
DIAGNOSE_EXCEPTIONS = {("verdict", "pad"), ("verdict", "joints"), ("verdict", "servo")}
ALLOWED_IN_CORE = ("lerobot_vtrefine.diagnose.verdict", "lerobot_vtrefine.diagnose.evidence")


def room_of(module: str) -> str | None:
    """Room of a module inside the diagnosis; None for others."""
    parts = module.split(".")
    if parts[:2] != ["lerobot_vtrefine", "diagnose"] or len(parts) < 3:
        return None
    return parts[2]


def room_violations(room: str, modules: list[str]) -> list[str]:
    """Names among ``modules`` that code of a room must not import."""
    targets = {module: target for module in modules if (target := room_of(module)) and target != room}
    return [
        module
        for module, target in targets.items()
        if DIAGNOSE_RANK[target] >= DIAGNOSE_RANK[room] and (room, target) not in DIAGNOSE_EXCEPTIONS
    ]


def diagnose_sources() -> list[tuple[str, Path]]:
    folder = PACKAGE / "diagnose"
    modules = {path: ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in folder.rglob("*.py")}
    return [(room, path) for path, module in modules.items() if (room := room_of(module))]


def test_room_rule_is_strict() -> None:
    assert room_violations("core", ["lerobot_vtrefine.diagnose.joints.fitting"])
    assert room_violations("joints", ["lerobot_vtrefine.diagnose.pad.selection"])
    assert room_violations("pad", ["lerobot_vtrefine.diagnose.camera.problem"])
    assert not room_violations("parts", ["lerobot_vtrefine.diagnose.core.search", "numpy"])


def test_rooms_of_the_diagnosis_import_only_from_rooms_above() -> None:
    wrong = {
        relative(path): bad
        for room, path in diagnose_sources()
        if (bad := room_violations(room, imported_modules(tree_of(path))))
    }
    assert wrong == {}


# Where decisions have all their thresholds in one file.
RULED_ROOMS = ("camera", "joints", "parts", "quality", "servo")
SOLVERS = ("joints/fitting.py", "joints/servo.py", "servo/fitting.py")
UNITS = {"BYTE", "HOUR_S", "MM_PER_M", "ZERO_C_IN_K"}


def is_number(node: ast.AST) -> bool:
    """Whether a part of an expression belongs to plain arithmetic or to a tuple."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float)
    return isinstance(node, ast.BinOp | ast.UnaryOp | ast.operator | ast.unaryop | ast.Tuple | ast.Load)


def numbers_compared_with(tree: ast.Module) -> set[str]:
    """Names of a module's own numbers, or tuples of them, that stand in one of its comparisons."""
    numbers = set()
    for node in tree.body:
        if isinstance(node, ast.Assign) and all(is_number(part) for part in ast.walk(node.value)):
            numbers |= {part.id for part in ast.walk(node.targets[0]) if isinstance(part, ast.Name)}
    compared = [node for node in ast.walk(tree) if isinstance(node, ast.Compare)]
    return numbers & {part.id for node in compared for part in ast.walk(node) if isinstance(part, ast.Name)}


def test_compared_numbers_are_found() -> None:
    found = numbers_compared_with(
        ast.parse("A, B = 0.1, 2\nC = -1 / 3\nD = 'd'\nx = y > 2 * A or z <= f(C) or u == D")
    )
    assert found == {"A", "C"}


def test_thresholds_stand_in_rules() -> None:
    """A cause's own may stand in the cause's file."""
    folder = PACKAGE / "diagnose"
    paths = [path for room in RULED_ROOMS for path in sorted((folder / room).glob("*.py"))]
    found = {
        name: numbers_compared_with(tree_of(path)) - UNITS
        for path in paths
        if (name := path.relative_to(folder).as_posix()) not in SOLVERS
    }
    assert {name: numbers for name, numbers in found.items() if numbers} == {}


def test_the_core_knows_no_instrument_and_names_no_cause() -> None:
    from lerobot_vtrefine.diagnose.verdict import CAUSES

    for path in sorted((PACKAGE / "diagnose" / "core").glob("*.py")):
        own = [name for name in imported_modules(tree_of(path)) if name.startswith("lerobot_vtrefine")]
        allowed = ("lerobot_vtrefine.diagnose.core", *ALLOWED_IN_CORE)
        assert [name for name in own if not name.startswith(allowed)] == [], relative(path)
        words = set(re.findall(r"\w+", path.read_text(encoding="utf-8")))
        assert words & {*CAUSES, "mujoco", "torch"} == set(), relative(path)
