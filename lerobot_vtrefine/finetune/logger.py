"""Training records: ``progress.csv`` and ``curves.png`` in the output folder, optionally Weights & Biases."""

import csv
import logging
from pathlib import Path
from typing import Any

from lerobot.configs.default import WandBConfig

from lerobot_vtrefine.files import read_number_rows
from lerobot_vtrefine.finetune.gpu_memory import COLUMNS
from lerobot_vtrefine.finetune.plots import draw_curves
from lerobot_vtrefine.whole_files import whole_file

CSV_NAME = "progress.csv"
CURVES_NAME = "curves.png"
CLOCK = frozenset({"seconds", "rollout_s", "steps_per_s", *COLUMNS})
"""Columns that tell how fast and how full the machine was, and nothing else."""


def read_progress(output_dir: Path) -> list[dict[str, float]]:
    """Rows of a run's ``progress.csv``; empty cells are left out."""
    path = output_dir / CSV_NAME
    if not path.is_file():
        return []
    return read_number_rows(path)


class ProgressLog:
    """One row of metrics per iteration.

    Resuming after an iteration drops the rows of later ones, which will be run again; a run that starts anew
    drops all. So a run that was interrupted has the rows of one that was not, but for those of `CLOCK`.
    """

    def __init__(self, output_dir: Path, iteration: int, wandb_run: Any | None) -> None:
        self.output_dir = output_dir
        earlier = read_progress(output_dir) if iteration else []
        self.rows = [row for row in earlier if row["iteration"] <= iteration]
        self._wandb_run = wandb_run

    def add(self, iteration: int, metrics: dict[str, float]) -> None:
        """Append a row and rewrite the files."""
        self.rows.append({"iteration": iteration, **metrics})
        columns = list(dict.fromkeys(key for row in self.rows for key in row))
        with whole_file(self.output_dir / CSV_NAME) as part, part.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows({**row, "iteration": int(row["iteration"])} for row in self.rows)
        if self._wandb_run is not None:
            self._wandb_run.log(metrics, step=iteration)

    def draw(self) -> None:
        """Draw the learning curves so far."""
        draw_curves(self.rows, self.output_dir / CURVES_NAME)

    def close(self) -> None:
        """Hand everything over to Weights & Biases."""
        if self._wandb_run is not None:
            self._wandb_run.finish()


def start_wandb(
    cfg: WandBConfig, output_dir: Path, job_name: str, settings: dict[str, Any], resume: bool
) -> Any:
    """A Weights & Biases run, or None if it is not enabled.

    The run's id is kept beside the checkpoints, so that a resumed run continues its curves. Curves and
    settings are logged; checkpoints stay on disk.

    Raises: ValueError if wandb refuses (no login, no connection), ImportError if it is not installed.
    """
    if not cfg.enable:
        return None
    try:
        import wandb
    except ImportError as error:
        raise ImportError("--wandb.enable=true needs the package wandb: pip install wandb") from error

    id_file = output_dir / "wandb_run_id"
    known = (id_file.read_text().strip() if resume and id_file.is_file() else "") or None
    try:
        run = wandb.init(
            id=cfg.run_id or known,
            project=cfg.project,
            entity=cfg.entity,
            name=job_name,
            notes=cfg.notes,
            tags=["policy:vt_dp3", "dppo", f"seed:{settings['seed']}"] if cfg.add_tags else None,
            dir=output_dir,
            config=settings,
            resume="allow",
            mode=cfg.mode,  # ty: ignore[invalid-argument-type]  LeRobot's config says str
        )
    except (wandb.Error, ValueError) as error:
        reason = str(error).strip().splitlines()[0].rstrip(".")
        raise ValueError(f"Weights & Biases: {reason}; --wandb.mode=offline logs without it") from error
    id_file.write_text(run.id)
    logging.info("logging to Weights & Biases as %s", run.id)
    return run
