"""Commands that run others, really interrupted: these may save first, and what is asked to go on does so."""

import fcntl
import os
import pty
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from lerobot_vtrefine.cli.pipeline.stages import QUIET_S, STOPPING
from lerobot_vtrefine.interrupts import KINDS

ROOT = Path(__file__).parents[2]
DEMO = """
import sys
from pathlib import Path
from types import SimpleNamespace
from lerobot_vtrefine.cli import demo
from lerobot_vtrefine.cli.pipeline.stages import Stage

folder = Path(sys.argv[1])
write = "import os, pathlib, sys, time; p = pathlib.Path(sys.argv[1]); p.parent.mkdir(exist_ok=True); "
first = write + "p.open('a').write('x')"
second = write + (
    "p.with_name('part').open('a').write('x'); again = p.with_name('pid').exists(); "
    "p.with_name('pid').write_text(str(os.getpid())); again or time.sleep(60); p.touch()"
)

def stage(name, code, **options):
    product = folder / name / "product"
    return Stage(name, name, ("python", "-c", code, str(product)), product.parent, product, **options)

# Importing torch would take longer than all else here.
sys.modules["lerobot_vtrefine.finetune.distributed"] = SimpleNamespace(check_device=lambda device: None)
demo.parse_config = lambda arguments: SimpleNamespace(output_dir=folder, device="cpu")
demo.demo_stages = lambda config: [stage("a", first), stage("b", second, needs=("a",), resumable=True)]
demo.write_report = lambda config, records: folder / "report.html"
raise SystemExit(demo.main())
"""


def alive(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    status = Path(f"/proc/{pid}/stat")
    return status.is_file() and status.read_text().rsplit(")", 1)[1].split()[0] != "Z"


def hear_everything() -> None:
    """In a child: these tests may be a shell's background job under ``nohup``, deaf to some signals."""
    for number in KINDS:
        signal.signal(number, signal.SIG_DFL)


def hear_all_but_interrupts() -> None:
    """As a shell's background jobs do."""
    hear_everything()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def text_of(note: Path, running: subprocess.Popen[str]) -> str:
    """What is written to a file, once it is."""
    deadline = time.monotonic() + 60
    while not (note.is_file() and note.read_text()):
        assert running.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return note.read_text()


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="looks at processes in /proc")
@pytest.mark.parametrize(
    ("number", "inherited"), [(signal.SIGINT, hear_everything), (signal.SIGTERM, hear_all_but_interrupts)]
)
def test_interrupted_demo_continues_from_its_last_finished_stage(
    tmp_path: Path, number: int, inherited: Callable[[], None]
) -> None:
    command = [sys.executable, "-c", DEMO, str(tmp_path)]
    running = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, preexec_fn=inherited
    )
    child = int(text_of(tmp_path / "b" / "pid", running))
    os.kill(running.pid, number)
    _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors.splitlines()[-1]) == (128 + number, "interrupted")
    assert not alive(child)

    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert again.stderr.count("done before") == 1
    assert (tmp_path / "a" / "product").read_text() == "x"
    assert (tmp_path / "b" / "part").read_text() == "xx"


SAVES_FIRST = """
import pathlib, sys, time
folder = pathlib.Path(sys.argv[1])
try:
    (folder / "begun").write_text("x")
    time.sleep(60)
except KeyboardInterrupt:
    (folder / "asked").write_text("x")
    try:
        time.sleep(float(sys.argv[2]))
        (folder / "saved").write_text("x")
    except KeyboardInterrupt:
        (folder / "stopped").write_text("x")
    sys.exit(130)
"""
"""A command that takes its time to end, as fine-tuning does."""
ONE_STAGE = """
import sys
from pathlib import Path
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.stages import Stage, StageRunner

folder, command = Path(sys.argv[1]), tuple(sys.argv[2:])
runner = StageRunner(folder, [Stage("a", "a", command, folder / "a", folder / "a" / "product")])
raise SystemExit(run_cli(lambda: runner.run() and None)())
"""
SIDE_BY_SIDE = """
import sys
from pathlib import Path
from lerobot_vtrefine.cli.errors import run_cli
from runs.side_by_side import run_all

folder, jobs, command = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
raise SystemExit(run_cli(lambda: run_all({folder / name: command for name in ("a", "b")[:jobs]}, jobs))())
"""

RELEASE_CHECK = """
import sys
from lerobot_vtrefine.cli.errors import run_cli
from release_check import run

raise SystemExit(run_cli(lambda: run(sys.argv[2:]))())
"""


def begin(code: str, folder: Path, *arguments: str, takes_s: float, **options) -> subprocess.Popen[str]:
    """A runner of the command above."""
    saves_first = (sys.executable, "-c", SAVES_FIRST, str(folder), str(takes_s))
    path = os.pathsep.join([str(ROOT), str(ROOT / "scripts")])
    options = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL} | options
    return subprocess.Popen(
        [sys.executable, "-c", code, str(folder), *arguments, *saves_first],
        text=True,
        env=os.environ | {"PYTHONPATH": path, "CUDA_VISIBLE_DEVICES": "0"},  # nobody asks torch for GPUs
        **{"preexec_fn": hear_everything} | options,
    )


def test_a_stage_may_save_before_it_ends(tmp_path: Path) -> None:
    running = begin(ONE_STAGE, tmp_path, takes_s=QUIET_S + 1.0)
    text_of(tmp_path / "begun", running)
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors.splitlines()[-2:]) == (130, [STOPPING, "interrupted"])
    assert (tmp_path / "saved").is_file()


def test_a_second_interrupt_ends_a_stage_at_once(tmp_path: Path) -> None:
    running = begin(ONE_STAGE, tmp_path, takes_s=600.0)
    text_of(tmp_path / "begun", running)
    running.send_signal(signal.SIGINT)
    text_of(tmp_path / "asked", running)
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors.splitlines()[-1]) == (130, "interrupted")
    assert (tmp_path / "stopped").is_file()


@pytest.mark.parametrize(
    ("jobs", "number"),
    [(1, signal.SIGINT), (2, signal.SIGINT), (1, signal.SIGTERM), (2, signal.SIGTERM), (2, signal.SIGHUP)],
)
def test_commands_of_a_script_may_save_before_they_end(tmp_path: Path, jobs: int, number: int) -> None:
    running = begin(SIDE_BY_SIDE, tmp_path, str(jobs), takes_s=1.0)
    text_of(tmp_path / "begun", running)
    running.send_signal(number)
    _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors.splitlines()[-1]) == (128 + number, "interrupted")
    assert (tmp_path / "saved").is_file()


def test_what_a_release_is_checked_by_ends_with_the_check(tmp_path: Path) -> None:
    running = begin(RELEASE_CHECK, tmp_path, takes_s=0.0)
    text_of(tmp_path / "begun", running)
    running.terminate()
    _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors.splitlines()[-1]) == (128 + signal.SIGTERM, "interrupted")
    assert (tmp_path / "saved").is_file()


def test_a_closed_terminal_lets_the_stage_of_a_scripts_command_save(tmp_path: Path) -> None:
    """Nothing can be printed any more, neither by the script nor by the command that it runs in sight."""
    terminal, its_end = pty.openpty()

    def own_terminal() -> None:
        hear_everything()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    inner = (sys.executable, "-c", ONE_STAGE, str(tmp_path))
    running = begin(
        SIDE_BY_SIDE,
        tmp_path,
        "1",
        *inner,
        takes_s=QUIET_S + 1.0,
        **dict.fromkeys(("stdin", "stdout", "stderr"), its_end),
        start_new_session=True,
        preexec_fn=own_terminal,
    )
    os.close(its_end)
    text_of(tmp_path / "begun", running)
    os.close(terminal)
    assert running.wait(timeout=60) == 128 + signal.SIGHUP
    assert (tmp_path / "saved").is_file()
