"""Ends stock `lerobot-record` at random moments, again and again, and checks what is left.

LeRobot is imported once; every session is a fork of this process that runs the command with emulated boards
and arms. After each end, in another fork, LeRobot's own loader reads the dataset: every episode that was
announced must be there, every column of it what the robot handed over, every pad's counts what its board
sent. Then `--resume=true` goes on, and is ended in its turn. `--disks` fills disks of these sizes [kB]
instead (Linux: mounts them in a namespace of its own):

    python tests/robots/soak_recording.py --kills=100
    python tests/robots/soak_recording.py --kills=20 --signals=SIGINT,SIGHUP,SIGTERM
    unshare -Urm python tests/robots/soak_recording.py --disks=300,700,1500,3000,6000
"""

import argparse
import faulthandler
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(tempfile.mkdtemp(prefix="soak"))
os.environ |= {"HF_HOME": str(FOLDER / "cache"), "HF_HUB_OFFLINE": "1"}

import dynamixel_sdk.port_handler  # noqa: E402
import numpy as np  # noqa: E402
from commands import dataset_flags  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from lerobot.scripts import lerobot_record  # noqa: E402
from lerobot.utils.import_utils import register_third_party_plugins  # noqa: E402
from rig import emulated_elsewhere  # noqa: E402

from lerobot_vtrefine.datasets import recovery  # noqa: E402, F401 (as it is now, however long this runs)
from lerobot_vtrefine.drivers.sources import check_pattern  # noqa: E402

FPS = 20
EPISODE_S = 0.3
SESSIONS_A_DATASET = 5
FIRST_FRAME_S = 60.0
LIMIT_S = 240.0
"""A session that takes longer hangs."""


@dataclass
class Session:
    """A running fork."""

    pid: int
    root: Path
    marks: Path
    """A line for every episode that begins or ends being saved."""

    def wait(self, limit_s: float = LIMIT_S) -> int | None:
        """Its status, None where it had to be killed."""
        deadline = time.monotonic() + limit_s
        while time.monotonic() < deadline:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.01)
        os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        return None

    def saving(self) -> int:
        return self.marks.read_text().count("saving")


def fork(work: Callable[[], None], log: Path) -> int:
    """Runs ``work`` in a fork whose output goes to ``log``."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background hears less
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(output, 1)
        os.dup2(output, 2)
        work()
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def digests(columns: dict[str, list], keys: list[str]) -> list[str]:
    """One text per frame."""
    rows = zip(*(columns[key] for key in keys), strict=True)
    return [hashlib.md5(b"".join(np.asarray(value).tobytes() for value in row)).hexdigest() for row in rows]


def keys_of(dataset: LeRobotDataset) -> list[str]:
    return sorted(key for key in dataset.features if key.startswith(("observation.", "action")))


def begin(root: Path, command: list[str], episodes: int) -> Session:
    """Starts or resumes a recording; notes on another disk what every episode holds before it is saved."""
    notes = root.parent.parent / f"{root.name}.sent"
    notes.mkdir(exist_ok=True)
    marks = notes / "marks"
    marks.write_text("")
    arguments = ["lerobot-record", *command, "--robot.rest_s=0.05"]
    arguments += dataset_flags(root, episodes, EPISODE_S, FPS)
    arguments += ["--resume=true"] if (root / "meta" / "info.json").is_file() else []
    save = LeRobotDataset.save_episode

    def saving(dataset: LeRobotDataset, *args: object, **kwargs: object) -> None:
        buffer = dataset.writer.episode_buffer
        sent = digests(buffer, keys_of(dataset))
        (notes / f"{dataset.num_episodes}.json").write_text(json.dumps(sent))
        with marks.open("a") as stream:
            stream.write("saving\n")
        save(dataset, *args, **kwargs)
        with marks.open("a") as stream:
            stream.write(f"saved {dataset.num_episodes}\n")

    def work() -> None:
        faulthandler.dump_traceback_later(0.9 * LIMIT_S, exit=False)
        LeRobotDataset.save_episode = saving
        sys.argv = arguments
        lerobot_record.main()

    return Session(fork(work, root.parent.parent / "log.txt"), root, marks)


def check(root: Path, marks: Path, claimed: int) -> None:
    """Runs in a fork: fails unless everything announced is there, exactly."""
    told = [int(line.split()[1]) for line in marks.read_text().splitlines() if line.startswith("saved")]
    claimed = max([claimed, *told])
    if not claimed:
        return
    dataset = LeRobotDataset("local/emulated", root=root)
    assert dataset.num_episodes >= claimed, (dataset.num_episodes, claimed)
    keys = keys_of(dataset)
    rows = dataset.hf_dataset.with_format("numpy")
    columns = {key: list(rows[key]) for key in [*keys, "episode_index"]}
    for key in keys:
        if key.startswith("observation.tactile."):
            assert all(check_pattern(counts.astype(np.uint8)) is not None for counts in columns[key]), key
    for key in keys:
        columns[key] = [value.astype(dataset.features[key]["dtype"]) for value in columns[key]]
    found = digests(columns, keys)
    for episode in range(claimed):
        begins, ends = (int(dataset.meta.episodes[episode][f"dataset_{end}_index"]) for end in ("from", "to"))
        sent = json.loads((root.parent.parent / f"{root.name}.sent" / f"{episode}.json").read_text())
        assert found[begins:ends] == sent, f"episode {episode} is not what was recorded"
        assert {int(index) for index in columns["episode_index"][begins:ends]} == {episode}


def is_right(session: Session) -> tuple[bool, int]:
    """Whether LeRobot reads everything announced, and how many episodes that is."""
    path = session.root / "meta" / "info.json"
    claimed = int(json.loads(path.read_text())["total_episodes"]) if path.is_file() else 0
    log = session.root.parent.parent / "check.txt"
    pid = fork(lambda: check(session.root, session.marks, claimed), log)
    return os.waitpid(pid, 0)[1] == 0, claimed


def end(session: Session, name: str, chance: random.Random) -> bool:
    """Ends a session at a random moment; whether it was in the middle of saving an episode."""
    anywhere = chance.random() < 0.5
    if anywhere:
        time.sleep(chance.uniform(0, 9))
    else:
        wanted, deadline = chance.randint(1, 4), time.monotonic() + FIRST_FRAME_S
        while session.saving() < wanted and time.monotonic() < deadline:
            if os.waitid(os.P_PID, session.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                break
            time.sleep(0.001)
        time.sleep(chance.uniform(0, 0.4))
    os.kill(session.pid, getattr(signal, name))
    if name == "SIGINT":
        time.sleep(chance.uniform(0, 0.5))
        os.kill(session.pid, signal.SIGINT)
    session.wait()
    lines = session.marks.read_text().splitlines()
    return bool(lines) and lines[-1] == "saving"


def kill(command: list[str], kills: int, names: list[str], chance: random.Random) -> Counter[str]:
    outcomes: Counter[str] = Counter()
    for number in range(kills):
        dataset, name = number // SESSIONS_A_DATASET, names[number % len(names)]
        root = FOLDER / "disk" / f"dataset{dataset}"
        session = begin(root, command, episodes=40)
        while_saving = end(session, name, chance)
        right, episodes = is_right(session)
        outcomes[f"{name}: {'right' if right else 'WRONG'}"] += 1
        outcomes["while saving"] += while_saving
        outcomes["nothing announced"] += episodes == 0
        print(f"{number + 1} {name} {root.name} {episodes} episodes {while_saving=} {right=}", flush=True)
        if number % SESSIONS_A_DATASET == SESSIONS_A_DATASET - 1 or number == kills - 1:
            outcomes[resumed(root, command, episodes)] += 1
    return outcomes


def resumed(root: Path, command: list[str], before: int) -> str:
    """Whether one more episode can be recorded to the end."""
    session = begin(root, command, episodes=1)
    status = session.wait()
    right, after = is_right(session)
    return (
        "resumed" if status == 0 and right and after > before else f"RESUMING FAILED {status} {right} {after}"
    )


def fill(command: list[str], sizes_kb: list[int]) -> Counter[str]:
    outcomes: Counter[str] = Counter()
    disk = FOLDER / "disk"
    for size in sizes_kb:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(disk)], check=True)
        session = begin(disk / f"full{size}", command, episodes=200)
        status = session.wait(300)
        right, episodes = is_right(session)
        text = (FOLDER / "log.txt").read_text().strip().splitlines()[-1]
        print(f"{size} kB: status {status}, {episodes} episodes, {right=}: {text}", flush=True)
        outcomes["right" if right and status == 1 else "WRONG"] += 1
        subprocess.run(["mount", "-o", f"remount,size={size + 20000}k", str(disk)], check=True)
        outcomes[resumed(session.root, command, episodes)] += 1
        subprocess.run(["umount", str(disk)], check=True)
    return outcomes


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--signals", default="SIGKILL")
    parser.add_argument("--disks", default="", help="sizes in kB")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    register_third_party_plugins()
    dynamixel_sdk.port_handler.LATENCY_TIMER = 120
    (FOLDER / "disk").mkdir()
    (FOLDER / "rig").mkdir()
    with emulated_elsewhere(FOLDER / "rig") as command:
        chance = random.Random(options.seed)
        outcomes = kill(command, options.kills, options.signals.split(","), chance)
        outcomes += fill(command, [int(size) for size in options.disks.split(",") if size])
    print(dict(outcomes))
    wrong = any("WRONG" in outcome or "FAILED" in outcome for outcome in outcomes)
    if wrong:
        print(f"see {FOLDER}")
    else:
        shutil.rmtree(FOLDER)
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
