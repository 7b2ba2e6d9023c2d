"""``vtrefine-demo`` really interrupted: its stage ends with it, and the next run goes on from there."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

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

demo.parse_config = lambda arguments: SimpleNamespace(output_dir=folder, device="cpu")
demo.demo_stages = lambda config: [stage("a", first), stage("b", second, needs=("a",), resumable=True)]
demo.write_report = lambda config, records: folder / "report.html"
raise SystemExit(demo.main())
"""


def alive(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    status = Path(f"/proc/{pid}/stat")
    return status.is_file() and status.read_text().rsplit(")", 1)[1].split()[0] != "Z"


def hear_interrupts() -> None:
    """A shell's background job, which these tests may be, starts its children deaf to Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="looks at processes in /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_demo_continues_from_its_last_finished_stage(tmp_path: Path, number: int) -> None:
    command = [sys.executable, "-c", DEMO, str(tmp_path)]
    running = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, preexec_fn=hear_interrupts
    )
    note = tmp_path / "b" / "pid"
    deadline = time.monotonic() + 60
    while not (note.is_file() and note.read_text()):
        assert running.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    child = int(note.read_text())
    os.kill(running.pid, number)
    _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors.splitlines()[-1]) == (130, "interrupted")
    assert not alive(child)

    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert again.stderr.count("done before") == 1
    assert (tmp_path / "a" / "product").read_text() == "x"
    assert (tmp_path / "b" / "part").read_text() == "xx"
