"""The documentation: the site builds with every link checked, notebooks run, the README's promises hold."""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_vtrefine.shipped import PREFIX, names

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
LINK = re.compile(r"\]\((?!https?://)([^)#\s]+)")
MAX_README_LINES = 150
FILES_OF_THE_READER = {"lerobot_vtrefine/diagnose/pad/candidates/column_sharing.py"}
"""What docs/own-cause.md lets its reader write."""


def test_make_docs_builds_the_site_with_strict_links(tmp_path: Path) -> None:
    pytest.importorskip("material", reason="pip install 'lerobot_policy_vtrefine[docs]'")
    build = re.search(
        r"^\t@.*/mkdocs (build .*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert build is not None, "make docs calls no mkdocs"
    command = [sys.executable, "-m", "mkdocs", *build[1].split(), "--site-dir", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    commands = (tmp_path / "commands.html").read_text(encoding="utf-8")
    assert "--num_episodes=int" in commands
    assert "--env.rules.limits" in (tmp_path / "settings.html").read_text(encoding="utf-8")
    for page in DOCS.glob("*.md"):
        assert (tmp_path / f"{page.stem}.html").is_file()


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= MAX_README_LINES


def test_links_of_pages_outside_the_site_lead_somewhere() -> None:
    missing = [
        f"{page.name}: {target}"
        for page in PAGES[:2]
        for target in LINK.findall(page.read_text(encoding="utf-8"))
        if not (page.parent / target).exists()
    ]
    assert missing == []


def test_docs_holds_pages_and_folders_alone() -> None:
    """Pictures lie in docs/img/, data in results/."""
    assert [path.name for path in DOCS.iterdir() if path.is_file() and path.suffix != ".md"] == []


def test_configurations_that_pages_name_exist() -> None:
    named = {
        name for page in PAGES for name in re.findall(rf"{PREFIX}(\w+)", page.read_text(encoding="utf-8"))
    }
    assert named - {"NAME"} <= names().keys()


def test_files_that_pages_name_exist() -> None:
    path = re.compile(r"`((?:lerobot_vtrefine|scripts|tests|configs|hub|results)/[\w./-]+\.\w+)`")
    named = {
        found
        for page in (ROOT / "SECURITY.md", *PAGES)
        for found in path.findall(page.read_text(encoding="utf-8"))
    }
    assert len(named) > 5
    assert {name for name in named if not (ROOT / name).exists()} <= FILES_OF_THE_READER


def test_commands_that_pages_name_exist() -> None:
    scripts = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    named = {
        name
        for page in PAGES
        for block in re.findall("```bash\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
        for name in re.findall(r"^(vtrefine(?:-[a-z-]+)?) ", block, re.MULTILINE)
    }
    assert len(named) > 5
    assert [name for name in named if f"\n{name} = " not in scripts] == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_stored_without_outputs(path: Path) -> None:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert [cell for cell in cells if cell.get("outputs") or cell.get("execution_count")] == []


MADE_BY_THE_READER = {"ColumnSharing"}
"""What docs/own-cause.md lets its reader write."""


def code_of(path: Path) -> str:
    """The Python in a page or a notebook."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        return "\n".join("".join(c["source"]) for c in json.loads(text)["cells"] if c["cell_type"] == "code")
    return "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))


def names_in(module: str) -> set[str]:
    """What can be imported from a module, read from its source: importing it takes seconds."""
    path = ROOT.joinpath(*module.split("."))
    if path.is_dir():
        below = {item.stem for item in path.iterdir()}
        return below | names_in(f"{module}.__init__")
    names = set()
    for node in ast.parse(path.with_suffix(".py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.ImportFrom):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            names |= {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
    return names


def test_names_that_pages_import_exist() -> None:
    statement = re.compile(r"^\s*from (lerobot_vtrefine[\w.]*) import ([\w, ]+)$", re.MULTILINE)
    imported = [
        (page.name, module, name.strip())
        for page in (*PAGES, *NOTEBOOKS)
        for module, names in statement.findall(code_of(page))
        for name in names.split(",")
    ]
    assert len(imported) > 10
    missing = [found for found in imported if found[2] not in names_in(found[1]) | MADE_BY_THE_READER]
    assert missing == []


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path: Path, tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=280, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    drawn = [
        output
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if "image/png" in output.get("data", {})
    ]
    assert drawn != []
