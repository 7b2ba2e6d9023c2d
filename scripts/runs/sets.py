"""Benchmarks of many independent sets: over processes of one core each, resumable, within a time.

Every finished set is a line of ``rows.jsonl`` at once, so that an interrupted run goes on where it stopped.
Delete the folder after a change of what is measured.
"""

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import numpy as np
from tqdm import tqdm

from lerobot_vtrefine.cli.arguments import at_least
from lerobot_vtrefine.cli.results.provenance import write_provenance
from lerobot_vtrefine.interrupts import ends_like_ctrl_c

ROWS = "rows.jsonl"
Row = dict[str, Any]


def add_arguments(parser: argparse.ArgumentParser, folder: Path) -> None:
    """How to run: --jobs, --minutes, --output_dir, --table."""
    parser.add_argument(
        "--jobs",
        type=at_least(1),
        default=os.cpu_count() or 1,
        help="processes of one core each (default: all cores)",
    )
    parser.add_argument(
        "--minutes", type=float, default=np.inf, help="begin no set after that time; what runs is finished"
    )
    parser.add_argument("--output_dir", type=Path, default=folder, help="where the sets' rows are kept")
    parser.add_argument("--table", action="store_true", help="print what is there, run nothing")


def shuffled[T](sets: Sequence[T]) -> list[T]:
    """In a fixed random order: the sets that a run reaches are a fair sample of all."""
    return [sets[i] for i in np.random.default_rng(0).permutation(len(sets))]


def read_rows(folder: Path) -> dict[str, Row]:
    """The rows that are there, by the sets' names; a line that was cut short counts for nothing."""
    path, rows = folder / ROWS, {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        rows[row["set"]] = row
    return rows


def run_sets[T](work: Callable[[T], Row], sets: dict[str, T], options: argparse.Namespace) -> list[Row]:
    """The row of every named set, as far as the time goes: read, or ``work(set)`` in a process of its own."""
    folder = options.output_dir
    folder.mkdir(parents=True, exist_ok=True)
    known = read_rows(folder)
    if options.table:
        return [known[name] for name in sets if name in known]
    write_provenance(folder)
    todo = {name: item for name, item in sets.items() if name not in known}
    last_start = time.time() + 60 * options.minutes
    context = multiprocessing.get_context("spawn")
    with (
        ends_like_ctrl_c(),
        ProcessPoolExecutor(options.jobs, context) as pool,
        (folder / ROWS).open("a", encoding="utf-8") as file,
    ):
        jobs = [pool.submit(partial(_row, work, last_start), name, item) for name, item in todo.items()]
        try:
            for job in tqdm(as_completed(jobs), total=len(jobs), unit="set", mininterval=10):
                if (row := job.result()) is not None:
                    file.write(f"\n{json.dumps(row)}" if file.tell() else json.dumps(row))
                    file.flush()
                    known[row["set"]] = row
        except KeyboardInterrupt:
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise
    return [known[name] for name in sets if name in known]


def _row[T](work: Callable[[T], Row], last_start: float, name: str, item: T) -> Row | None:
    """One set's row, as JSON gives it back; None after the last time to begin."""
    if time.time() > last_start:
        return None
    begin = time.process_time()
    row = work(item)
    row |= {"set": name, "total_cpu_s": round(time.process_time() - begin, 1)}
    return json.loads(json.dumps(row, default=lambda value: value.tolist()))
