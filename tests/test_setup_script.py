"""The set-up script finds an interpreter, installs once, and says in one line what is missing."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOOLS = ("sh", "cat", "cksum", "date", "dirname", "rm", "mkdir", "cp", "sed")

# Pretends to be Python 3.12: starts, makes an environment that holds itself, and notes what it installs.
FAKE_PYTHON = """#!/bin/sh
case "$1 $2" in
    "-m venv") mkdir -p "$3/bin" && cp "$0" "$3/bin/python" ;;
    "-m pip") echo "$*" >>"$FAKE_LOG" ;;
esac
"""
# Pretends to be uv: notes each call; makes an environment only where the test says that it can.
FAKE_UV = """#!/bin/sh
echo "uv $*" >>"$FAKE_LOG"
[ "$1" = venv ] || exit 0
case "$*" in
    *--no-python-downloads*) [ -e "$HOME/uv_finds" ] || exit 1 ;;
    *) [ -e "$HOME/uv_downloads" ] || exit 1 ;;
esac
for last; do :; done
mkdir -p "$last/bin" && cp "$HOME/fake_python" "$last/bin/python"
"""
# An environment by uv on a Debian interpreter: neither venv nor ensurepip can be imported.
WITHOUT_ENSUREPIP = """#!/bin/sh
case "$*" in *ensurepip*) exit 1 ;; esac
"""
BROKEN_SHIM = "#!/bin/sh\necho 'pyenv: python3.12: command not found' >&2\nexit 127\n"


def executable(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the script and what it reads, and a path that holds nothing but basic tools."""
    for name in ("pyproject.toml", "constraints.txt", "scripts/setup_venv.sh"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "tools").mkdir()
    for tool in TOOLS:
        (tmp_path / "tools" / tool).symlink_to(shutil.which(tool))
    executable(tmp_path / "tools" / "python3.12", BROKEN_SHIM)
    return tmp_path


def run(checkout: Path) -> subprocess.CompletedProcess[str]:
    environment = {
        "PATH": str(checkout / "tools"),
        "HOME": str(checkout),
        "PYENV_ROOT": str(checkout / "pyenv"),
        "FAKE_LOG": str(checkout / "log"),
    }
    script = str(checkout / "scripts" / "setup_venv.sh")
    return subprocess.run(
        [shutil.which("sh"), script], env=environment, capture_output=True, text=True, check=False
    )


def test_nothing_usable_gives_one_line(checkout: Path) -> None:
    result = run(checkout)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: no Python 3.12 or 3.13")


@pytest.mark.parametrize("where", ["tools/python3.13", "pyenv/versions/3.12.9/bin/python"])
def test_finds_a_working_interpreter(checkout: Path, where: str) -> None:
    executable(checkout / where, FAKE_PYTHON)
    result = run(checkout)
    assert result.returncode == 0, result.stderr
    assert "Creating .venv with" in result.stderr
    assert where in result.stderr or Path(where).name in result.stderr
    assert "-c constraints.txt -e .[dev]" in (checkout / "log").read_text()


def test_second_run_starts_at_once_until_pins_change(checkout: Path) -> None:
    executable(checkout / "tools" / "python3.13", FAKE_PYTHON)
    run(checkout)
    installed = (checkout / "log").read_text()
    assert run(checkout).stderr == ""
    assert (checkout / "log").read_text() == installed
    with (checkout / "constraints.txt").open("a") as file:
        file.write("# a new pin\n")
    assert "Installing" in run(checkout).stderr


def test_broken_environment_is_made_anew(checkout: Path) -> None:
    executable(checkout / "tools" / "python3.13", FAKE_PYTHON)
    executable(checkout / ".venv" / "bin" / "python", BROKEN_SHIM)
    result = run(checkout)
    assert result.returncode == 0, result.stderr
    assert "Creating .venv" in result.stderr


def with_uv(checkout: Path, *abilities: str) -> None:
    executable(checkout / "tools" / "uv", FAKE_UV)
    executable(checkout / "fake_python", WITHOUT_ENSUREPIP)
    for ability in abilities:
        (checkout / ability).touch()


def venv_calls(checkout: Path) -> list[bool]:
    """For each environment asked of uv, whether a download was allowed."""
    calls = [line for line in (checkout / "log").read_text().splitlines() if line.startswith("uv venv")]
    return ["--no-python-downloads" not in call for call in calls]


def test_uv_uses_what_is_installed(checkout: Path) -> None:
    with_uv(checkout, "uv_finds")
    assert run(checkout).returncode == 0
    assert venv_calls(checkout) == [False]


def test_installed_interpreter_comes_before_a_download(checkout: Path) -> None:
    with_uv(checkout, "uv_downloads")
    executable(checkout / "tools" / "python3.13", FAKE_PYTHON)
    assert "Creating .venv with" in run(checkout).stderr
    assert venv_calls(checkout) == [False]


def test_download_is_the_last_resort(checkout: Path) -> None:
    with_uv(checkout, "uv_downloads")
    assert run(checkout).returncode == 0
    assert venv_calls(checkout) == [False, True]


def test_environment_of_uv_survives_new_pins(checkout: Path) -> None:
    with_uv(checkout, "uv_finds")
    run(checkout)
    (checkout / ".venv" / "mine").touch()
    with (checkout / "constraints.txt").open("a") as file:
        file.write("# a new pin\n")
    assert "Installing" in run(checkout).stderr
    assert (checkout / ".venv" / "mine").exists()


def test_script_is_posix() -> None:
    dash = shutil.which("dash")
    if dash is None:
        pytest.skip("dash is not installed")
    script = str(ROOT / "scripts" / "setup_venv.sh")
    assert subprocess.run([dash, "-n", script], check=False, env=os.environ).returncode == 0
