"""Stages of a pipeline: commands with stamps, so that a restarted run continues where it was."""

import contextlib
import hashlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lerobot_vtrefine.cli.errors import nobody_reads
from lerobot_vtrefine.cli.pipeline.progress import LiveLine, parse_progress, read_tail
from lerobot_vtrefine.cli.results.provenance import commit
from lerobot_vtrefine.files import decode, read_json
from lerobot_vtrefine.interrupts import ends_like_ctrl_c, interrupts_wait

POLL_S = 0.25
QUIET_S = 2.0
"""How long nothing is said of a command that was asked to end."""
PATIENCE_S = 120.0
"""How long it may then take: fine-tuning finishes its iteration and saves it."""
STOP_TIMEOUT_S = 10.0
"""The same once it was asked again."""
STOPPING = "the stage that runs saves what it has; interrupt again to stop it at once"


@dataclass(frozen=True)
class Stage:
    """One command of a pipeline.

    Args:
        name: identifier, also of the log and the stamp.
        title: what a person reads.
        command: the command line, exactly as a user would type it.
        output: folder that the command fills; removed before a fresh start.
        product: file that a finished stage leaves.
        needs: names of the stages whose products it reads; when one of them changes, this one runs again.
        resumable: the command itself continues from what an interrupted run left in ``output``.
    """

    name: str
    title: str
    command: tuple[str, ...]
    output: Path
    product: Path
    needs: tuple[str, ...] = ()
    resumable: bool = False

    @property
    def line(self) -> str:
        """The command as one shell line."""
        return shlex.join(self.command)


@dataclass(frozen=True)
class StageRecord:
    """What a finished stage leaves in its stamp.

    ``seconds`` is the wall time of all processes that it took, ``key`` the fingerprint of what it did,
    ``commit`` the code's; None where that is not known.
    """

    name: str
    title: str
    command: str
    seconds: float
    key: str
    commit: str | None = None


def trained_policy(folder: Path) -> Path:
    """What --policy.path takes of the folder that lerobot-train or vtrefine-finetune has filled."""
    return folder / "checkpoints" / "last" / "pretrained_model"


def evaluation_stage(
    title: str,
    flags: Sequence[str],
    output: Path,
    episodes: int,
    at_once: int,
    seed: int,
    needs: tuple[str, ...] = (),
) -> Stage:
    """Stock lerobot-eval, whose ``flags`` name policy and environment, on ``episodes`` from ``seed`` on."""
    command = (
        "lerobot-eval",
        *flags,
        f"--eval.n_episodes={episodes}",
        f"--eval.batch_size={min(at_once, episodes)}",
        f"--seed={seed}",
        f"--output_dir={output}",
    )
    return Stage(output.name, title, command, output, output / "eval_info.json", needs)


def stage_keys(stages: list[Stage]) -> dict[str, str]:
    """Fingerprint of each stage: its command and the fingerprints of the stages it needs."""
    keys: dict[str, str] = {}
    for stage in stages:
        parts = [stage.line, *(keys[name] for name in stage.needs)]
        keys[stage.name] = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    return keys


class StageRunner:
    """Runs stages in order below ``directory``, skipping those whose stamp says that they are done."""

    def __init__(self, directory: Path, stages: list[Stage], line: LiveLine | None = None) -> None:
        self.directory = directory
        self.stages = stages
        self.keys = stage_keys(stages)
        self.line = line or LiveLine()

    def run(self) -> list[StageRecord]:
        """Run what is not done yet; return a record of every stage.

        Raises:
            ChildProcessError: a command failed; the message names its log and quotes its last line.
        """
        return list(self.records())

    def records(self) -> Iterator[StageRecord]:
        """As ``run``, each record as soon as its stage is done."""
        for number, stage in enumerate(self.stages, 1):
            yield self._run_stage(number, stage)

    def _run_stage(self, number: int, stage: Stage) -> StageRecord:
        label = f"[{number}/{len(self.stages)}] {stage.title}"
        record = self._finished(stage)
        if record is not None:
            self.line.finish(label, f"done before, {record.seconds:.0f} s")
            return record
        earlier, started = self._prepare(stage), time.monotonic()
        try:
            self._execute(stage, label)
        finally:
            seconds = earlier + time.monotonic() - started
            self._note_start(stage, seconds)
        key = self.keys[stage.name]
        record = StageRecord(stage.name, stage.title, stage.line, round(seconds, 1), key, commit())
        self._stamp(stage).write_text(json.dumps(asdict(record), indent=2), encoding="utf-8")
        self.line.finish(label, f"{seconds:.0f} s")
        return record

    def _prepare(self, stage: Stage) -> float:
        """Remove what an earlier run left, unless the command continues from exactly that.

        Returns: seconds that interrupted runs have spent on what is continued. Stages that need this one lose
        their stamps, so that they run again even if this process ends before it reaches them.
        """
        for later in self._dependants(stage):
            self._stamp(later).unlink(missing_ok=True)
            self._start_note(later).unlink(missing_ok=True)
        self._stamp(stage).unlink(missing_ok=True)
        seconds = self._seconds_spent(stage) if stage.resumable else None
        if seconds is None:
            shutil.rmtree(stage.output, ignore_errors=True)
        self._note_start(stage, seconds or 0.0)
        return seconds or 0.0

    def _dependants(self, stage: Stage) -> list[Stage]:
        """The stages that need this one, directly or through others."""
        changed = {stage.name}
        for later in self.stages:
            if changed.intersection(later.needs):
                changed.add(later.name)
        return [later for later in self.stages if later.name in changed and later is not stage]

    def _start_note(self, stage: Stage) -> Path:
        """Two lines about a run that may have been interrupted: the stage's key, and seconds spent on it."""
        return self._stamp(stage).with_suffix(".started")

    def _note_start(self, stage: Stage, seconds: float) -> None:
        note = self._start_note(stage)
        note.parent.mkdir(parents=True, exist_ok=True)
        note.write_text(f"{self.keys[stage.name]}\n{seconds:.1f}", encoding="utf-8")

    def _seconds_spent(self, stage: Stage) -> float | None:
        """Seconds that earlier runs of the very same stage took; None if there was none."""
        note = self._start_note(stage)
        key, _, seconds = (note.read_text(encoding="utf-8") if note.is_file() else "").partition("\n")
        return float(seconds or 0.0) if key == self.keys[stage.name] else None

    def _finished(self, stage: Stage) -> StageRecord | None:
        stamp = self._stamp(stage)
        if not (stamp.is_file() and stage.product.exists()):
            return None
        try:
            record = decode(StageRecord, read_json(stamp), "the stamp of a stage")
        except ValueError as error:
            raise ValueError(f"{error}; remove {stamp} to run this stage again") from error
        return record if record.key == self.keys[stage.name] else None

    def _stamp(self, stage: Stage) -> Path:
        return self.directory / "stages" / f"{stage.name}.json"

    def log_path(self, stage: Stage) -> Path:
        """Where everything goes that the stage's command prints."""
        return self.directory / "logs" / f"{stage.name}.log"

    def _execute(self, stage: Stage, label: str) -> None:
        log = self.log_path(stage)
        log.parent.mkdir(parents=True, exist_ok=True)
        log.unlink(missing_ok=True)  # a command that outlived an earlier run may go on writing to its own
        started = time.monotonic()
        with log.open("wb") as file, own_sessions() as start:
            file.write(f"$ {stage.line}\n".encode())
            file.flush()
            child = start(
                [find_command(stage.command[0]), *stage.command[1:]],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=child_environment(),
            )
            try:
                while child.poll() is None:
                    self.line.show(label, parse_progress(read_tail(log)), time.monotonic() - started)
                    time.sleep(POLL_S)
            except BaseException:
                self.line.stop()
                raise
        if child.returncode:
            self.line.finish(label, "failed")
            raise ChildProcessError(failure_message(stage, child.returncode, log))
        if not stage.product.exists():
            raise ChildProcessError(f"stage {stage.name} wrote no {stage.product}; see {log}")


def find_command(name: str) -> str:
    """Path of a console script: beside the running interpreter, else on the path.

    Raises:
        FileNotFoundError: it is in neither place.
    """
    beside = str(Path(sys.executable).parent)
    found = shutil.which(name, path=beside) or shutil.which(name)
    if found is None:
        raise FileNotFoundError(f"command {name} not found; is this project installed? (make setup)")
    return found


def child_environment() -> dict[str, str]:
    """Environment of the stages: nothing is fetched from the Hub, logs hold one bar update per second."""
    quiet = {"HF_HUB_OFFLINE": "1", "TQDM_MININTERVAL": "1", "PYTHONUNBUFFERED": "1"}
    return quiet | dict(os.environ)


def stop(*children: subprocess.Popen[bytes]) -> None:
    """Ask children and their workers to end as Ctrl-C does, again where there is another Ctrl-C or they take
    long, and end them if they do not.
    """
    for stream in (sys.stdout, sys.stderr):
        nobody_reads(stream)  # a closed terminal makes every print an error
    _signal(children, signal.SIGINT)
    with contextlib.suppress(KeyboardInterrupt):
        if not _have_ended(children, QUIET_S):
            print(STOPPING, file=sys.stderr)
            _have_ended(children, PATIENCE_S)
    end(*children)


def end(*children: subprocess.Popen[bytes]) -> None:
    """Ask children and their workers to end as Ctrl-C does, and end them if they do not at once."""
    with contextlib.suppress(KeyboardInterrupt):
        if not _have_ended(children, 0.0):
            _signal(children, signal.SIGINT)
            _have_ended(children, STOP_TIMEOUT_S)
    _signal(children, signal.SIGKILL)
    for child in children:
        child.wait()


@contextlib.contextmanager
def own_sessions(ending: Callable[..., None] = stop) -> Generator[Callable[..., subprocess.Popen[bytes]]]:
    """Commands in sessions of their own, so that what this process is sent reaches them by it alone, once.

    What still runs when the block ends, by Ctrl-C, SIGTERM, SIGHUP or an error, is ended by ``ending``.

    Yields: starts a command, with the options of ``subprocess.Popen``.
    """
    children: list[subprocess.Popen[Any]] = []

    def start(command: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
        with interrupts_wait():
            prepare = partial(_hear_interrupts, options.pop("preexec_fn", None))
            children.append(subprocess.Popen(command, start_new_session=True, preexec_fn=prepare, **options))
        return children[-1]

    with ends_like_ctrl_c():
        try:
            yield start
        finally:
            if running := [child for child in children if child.poll() is None]:
                ending(*running)


def _hear_interrupts(prepare: Callable[[], None] | None) -> None:
    """In a child: a shell starts jobs in the background deaf to Ctrl-C, which children would inherit."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if prepare is not None:
        prepare()


def _signal(children: Sequence[subprocess.Popen[bytes]], number: int) -> None:
    for child in children:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, number)


def _have_ended(children: Sequence[subprocess.Popen[bytes]], timeout_s: float) -> bool:
    """Whether all do within a time."""
    until = time.monotonic() + timeout_s
    try:
        for child in children:
            child.wait(max(0.0, until - time.monotonic()))
    except subprocess.TimeoutExpired:
        return False
    return True


def failure_message(stage: Stage, status: int, log: Path) -> str:
    """One line about a failed stage, with the last line that its command printed."""
    return f"stage {stage.name} failed with status {status}: {last_line(log)} (all output in {log})"


def last_line(log: Path) -> str:
    """The last line with anything on it, or "no output"."""
    lines = [line.strip() for line in read_tail(log).replace("\r", "\n").splitlines() if line.strip()]
    return lines[-1] if lines else "no output"
