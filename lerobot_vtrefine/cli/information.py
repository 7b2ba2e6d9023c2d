"""``vtrefine-information``: measure what joints, vision and touch know in a task, before a policy is trained.

example:
  vtrefine-information --config_path=vtrefine:round_grasped --output_dir=outputs/information
"""

import logging
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs import parser
from lerobot.configs.default import EvalConfig
from lerobot.envs.configs import EnvConfig
from lerobot.utils.utils import init_logging
from tqdm import tqdm

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import OVERWRITE, staged
from lerobot_vtrefine.cli.results.provenance import write_provenance
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.config import checked_env
from lerobot_vtrefine.finetune.distributed import check_device
from lerobot_vtrefine.information.contact import SIDE, TOUCHING
from lerobot_vtrefine.information.estimator import POLICY, SENSES
from lerobot_vtrefine.information.page import render_page
from lerobot_vtrefine.information.quantities import unit_of
from lerobot_vtrefine.information.study import Effort, Study, save_keeper, study, write

FILES = ("information.json", "report.html")


@dataclass
class InformationConfig:
    """Flags of ``vtrefine-information``."""

    output_dir: Path = Path("outputs/information")
    """Folder of information.json, report.html and the trained encoders."""
    overwrite: bool = False
    """Replace a study that is there already."""
    env: EnvConfig = field(default_factory=VtRefineEnvConfig)
    """The task that is looked into."""
    senses: tuple[str, ...] = ("joints", "visual", "tactile", "visuo_tactile")
    """Of joints, visual, tactile, visuo_tactile, visuo_tactile_cloud (paper: taxels as points)."""
    effort: Effort = field(default_factory=Effort)
    """How much is simulated and trained."""
    eval: EvalConfig = field(default_factory=EvalConfig)
    """Unused; lets files of configs/env serve this command too."""

    def __post_init__(self) -> None:
        unknown = [name for name in self.senses if name not in SENSES]
        if unknown or not self.senses:
            raise ValueError(f"--senses={','.join(self.senses)}: choose from {', '.join(SENSES)}")
        checked_env(self.env)


class Bars:
    """One progress bar per kind of work."""

    def __init__(self) -> None:
        self._bars: dict[str, tqdm] = {}

    def __call__(self, label: str, total: int, done: int) -> None:
        """As ``study.Told``."""
        bar = self._bars.setdefault(label, tqdm(total=total, desc=label))
        bar.update(done)


SHOWN = ("plug_in_socket_y", "plug_in_hand_x", "plug_in_hand_rx")
"""Quantities that the terminal shows: where the plug is over the hole, and how it lies in its hand."""


CONTACT_SHOWN = {TOUCHING: "do they touch [right]", SIDE: "on which side [right]"}


def summary(found: Study) -> str:
    """A few lines for the terminal."""
    heads = [f"{name.replace('_', ' ')} [{unit_of(name)[1]}]" for name in SHOWN]
    contact = [name for name in CONTACT_SHOWN if name in found.contact_unseen]
    heads += [CONTACT_SHOWN[name] for name in contact]
    unseen = [*(found.prior[name] for name in SHOWN), *(found.contact_unseen[name] for name in contact)]
    lines = ["errors on held-out episodes (RMS):", "  " + " " * 32 + "".join(f"{head:>24}" for head in heads)]
    lines.append(f"  {'nothing seen':<32}" + "".join(f"{value:>24.2f}" for value in unseen))
    for finding in found.findings:
        network = "" if finding.network == POLICY else f" {finding.network}"
        label = f"{finding.senses}{network}, {finding.history} frame{'s' * (finding.history > 1)}"
        known = [*(finding.rms[name] for name in SHOWN), *(finding.contact[name] for name in contact)]
        errors = ("{:.2f} [{:.2f}, {:.2f}]".format(*values) for values in known)
        success = (
            "" if finding.success is None else f"   expert: {finding.success[0]} of {finding.success[1]}"
        )
        lines.append(f"  {label:<32}" + "".join(f"{error:>24}" for error in errors) + success)
    if found.true_success is not None:
        lines.append(f"  expert that knows the truth: {found.true_success[0]} of {found.true_success[1]}")
    return "\n".join([*lines, found.verdict.reason])


@parser.wrap()
def information(cfg: InformationConfig) -> None:
    """Study one task and write what was found."""
    env = checked_env(cfg.env)
    check_device(cfg.effort.device, "--effort.device")
    with staged(cfg.output_dir, FILES, overwrite=cfg.overwrite, flag=OVERWRITE) as folder:
        found = study(env, cfg.senses, cfg.effort, Bars(), save_keeper(folder, cfg.effort))
        write(found, cfg.effort, folder)
        scene = env.scene_config
        page = render_page(found, scene.pair, scene.clearance_m)
        (folder / FILES[1]).write_text(page, encoding="utf-8")
        write_provenance(folder)
    print(summary(found))
    logging.info("everything is in %s", cfg.output_dir)


@run_cli
def main() -> None:
    """Console entry point."""
    init_logging()
    information()


if __name__ == "__main__":
    raise SystemExit(main())
