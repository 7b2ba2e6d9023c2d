"""Is the wheel fit to be released? Build and check it, and do what the README says in an empty place.

    python scripts/release_check.py [--dist_only]

The README's blocks after ``<!-- release-check -->`` run line by line in an empty folder, in an environment
that holds the wheel and its dependencies only; ``pip`` stands for uv's, and this name comes from the
build. UV_TORCH_BACKEND=cpu in the environment saves most of the download.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

from runs.side_by_side import run_one

from lerobot_vtrefine.cli.errors import run_cli

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "outputs" / "release"
NAME = "lerobot_policy_vtrefine"
BLOCK = re.compile(r"<!-- release-check -->\s*```bash\n(.*?)```", re.DOTALL)


def find_uv() -> str:
    """The uv command; FileNotFoundError without one."""
    found = shutil.which("uv") or shutil.which("uv", path=str(Path(sys.executable).parent))
    if found is None:
        raise FileNotFoundError("uv is not installed: pip install uv")
    return found


def build(uv: str) -> Path:
    """Wheel and source archive in a new folder; the wheel's path."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    dist = FOLDER / "dist"
    run([uv, "build", "--quiet", "--python", sys.executable, "--out-dir", str(dist), str(ROOT)])
    archives = sorted(str(path) for path in dist.glob("*.*") if path.suffix in (".whl", ".gz"))
    run([uv, "tool", "run", "--quiet", "twine", "check", "--strict", *archives])
    return next(dist.glob("*.whl"))


def readme_lines() -> list[str]:
    """The README's commands that somebody without the repository types, without comments."""
    blocks = BLOCK.findall((ROOT / "README.md").read_text(encoding="utf-8"))
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [text for line in lines if (text := re.sub(r"\s+#.*", "", line).strip())]


def try_out(uv: str, wheel: Path) -> None:
    """Install into an empty environment and run the README's lines there."""
    place, venv = FOLDER / "empty", FOLDER / "venv"
    place.mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    environment |= {
        "VIRTUAL_ENV": str(venv),
        "UV_FIND_LINKS": str(wheel.parent),
        "UV_CONSTRAINT": str(ROOT / "constraints.txt"),
        "PATH": f"{venv / 'bin'}{os.pathsep}{Path(uv).parent}{os.pathsep}{os.environ['PATH']}",
    }
    run([uv, "venv", "--quiet", "--python", sys.executable, str(venv)])
    for line in ["pip install " + NAME, "vtrefine --version", *readme_lines(), "vtrefine"]:
        called = re.sub("^pip ", "uv pip ", line)
        run(["bash", "-e", "-c", called], cwd=place, env=environment)
    for name in sorted(path.name for path in (venv / "bin").glob("vtrefine-*")):
        run([str(venv / "bin" / name), "--help"], cwd=place, env=environment, stdout=subprocess.DEVNULL)


def run(command: list[str], **options: object) -> None:
    """Run and say how long it took; CalledProcessError when it fails."""
    started = time.monotonic()
    shown = command[-1] if command[0] == "bash" else " ".join(command)
    print(f"$ {shown.replace(str(ROOT) + '/', '')}", flush=True)
    run_one(command, **options)
    print(f"  {time.monotonic() - started:.1f} s", flush=True)


@run_cli
def main() -> None:
    """Build, check, try."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dist_only", action="store_true", help="build and check metadata, install nothing")
    options = parser.parse_args()
    uv = find_uv()
    wheel = build(uv)
    if not options.dist_only:
        try_out(uv, wheel)
    print(f"{wheel.relative_to(ROOT)} is fit to be released")


if __name__ == "__main__":
    sys.exit(main())
