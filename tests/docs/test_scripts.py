"""Scripts: each in scripts/ is a command that tells how it is used, and pages name flags that it has."""

import json
import re
from pathlib import Path

import pytest
from command_uses import uses
from loaded_process import LoadedProcess

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
RUN_BY_OTHERS = {"docs_hooks"}
"""mkdocs imports it."""
SCRIPT = r"(?:\./)?scripts/(\w+)\.py"

# All in one process: importing what they need takes most of the time.
ASK = """
import contextlib, io, json, runpy, sys
_, paths, *sys.path[:0] = sys.argv
found = {}
for path in json.loads(paths):
    sys.argv = [path, "--help"]
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        try:
            status = runpy.run_path(path, run_name="__main__") and None
        except SystemExit as stop:
            status = stop.code
    found[path] = [status, out.getvalue()]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def helps(loaded: LoadedProcess) -> dict[str, str]:
    """What --help of every script prints."""
    paths = [str(path) for path in sorted(SCRIPTS.glob("*.py")) if path.stem not in RUN_BY_OTHERS]
    done = loaded.run(ASK, json.dumps(paths), *map(str, (SCRIPTS, ROOT)))
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.strip().splitlines()[-1])
    assert [path for path, (status, _) in found.items() if status != 0] == []
    return {Path(path).stem: text for path, (_, text) in found.items()}


def test_every_script_tells_how_it_is_used(helps: dict[str, str]) -> None:
    for name, text in helps.items():
        assert text.startswith(f"usage: {name}.py"), name
        assert f"scripts/{name}.py" in text, f"{name} shows no example"
        bare = re.findall(r"^  (-[^\n]*\S)\n(?!   )", text + "\n", re.MULTILINE)
        assert [flag for flag in bare if "  " not in flag] == [], f"{name} does not say what these are"


def test_uses_are_found() -> None:
    text = "`scripts/a.py one --b=1`\n```bash\npython scripts/c.py --d \\\n    --e=2 && make f  # --g\n```"
    assert uses(text, SCRIPT) == [("a", ["--b"]), ("c", ["--d", "--e"])]


def test_flags_that_pages_and_scripts_give_to_scripts_exist(helps: dict[str, str]) -> None:
    shown = {page.name: page.read_text(encoding="utf-8") for page in PAGES}
    shown |= {name: f"```bash\n{text.partition('options:')[0]}```" for name, text in helps.items()}
    wrong, checked = [], 0
    for place, text in shown.items():
        for name, flags in uses(text, SCRIPT):
            passes_on = "parse_known_args" in (SCRIPTS / f"{name}.py").read_text(encoding="utf-8")
            known = set(re.findall(r"--\w+", helps[name]))
            wrong += [f"{place}: {name}.py {flag}" for flag in flags if not passes_on and flag not in known]
            checked += len(flags)
    assert wrong == []
    assert checked > 50
