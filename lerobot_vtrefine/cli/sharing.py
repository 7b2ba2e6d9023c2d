"""Datasets and policies on the Hugging Face Hub, with cards that say what they are and how good."""

import json
import shlex
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lerobot_vtrefine.cli.arguments import flags
from lerobot_vtrefine.cli.report.results import load_evaluation, percent
from lerobot_vtrefine.envs.evaluation_note import read_note
from lerobot_vtrefine.files import read_json, read_json_lines
from lerobot_vtrefine.finetune.seeds import TRAINING_SEEDS

CHECKPOINT_FILES = (
    "config.json",
    "model.safetensors",
    "policy_preprocessor.json",
    "policy_postprocessor.json",
)
"""What another machine needs to run a policy; the processors hold the point cloud's settings."""
TRAIN_CONFIG = "train_config.json"
CARD, EPISODES = "README.md", "episodes.jsonl"
TASK_FIELDS = ("pair", "clearance_m", "start", "backend")
MEASURED = (
    ("in_hand_shift_m", "in-hand shift", 1e3, "mm"),
    ("peak_force_n", "peak contact force", 1.0, "N"),
    ("time_to_success_s", "time to success", 1.0, "s"),
)


def push_dataset(root: Path, repo_id: str, *, private: bool) -> None:
    """Upload a LeRobotDataset, with a card that describes its pads.

    Raises:
        FileNotFoundError, ValueError: part of it is not there, or cannot be read; nothing was changed.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_vtrefine.lerobot_compat import card
    from lerobot_vtrefine.lerobot_compat.completeness import check_complete

    check_complete(root)
    card.install()
    LeRobotDataset(repo_id, root=root).push_to_hub(private=private)


def push_policy(folder: Path, repo_id: str, evaluation: Path | None, *, private: bool) -> None:
    """Write a card into the checkpoint's folder and upload all of it, processors included.

    Raises:
        FileNotFoundError: the checkpoint lacks a file that others need to run it.
    """
    from huggingface_hub import HfApi

    if missing := [name for name in CHECKPOINT_FILES if not (folder / name).is_file()]:
        raise FileNotFoundError(f"{folder} lacks {missing[0]}: name a folder such as .../pretrained_model")
    text = policy_card(folder, repo_id, evaluation)
    api = HfApi()
    api.create_repo(repo_id=repo_id, private=private, exist_ok=True)
    (folder / CARD).write_text(text, encoding="utf-8")  # not before: without a network nothing is left behind
    api.upload_folder(repo_id=repo_id, folder_path=folder, allow_patterns=None, ignore_patterns=None)


def policy_card(folder: Path, repo_id: str, evaluation: Path | None) -> str:
    """The card: what the policy is, how it was trained, how often it succeeds, how to see the same."""
    policy = _settings(folder / "config.json")
    training = _settings(folder / TRAIN_CONFIG) if (folder / TRAIN_CONFIG).is_file() else {}
    parts = [
        f"---\nlicense: {policy.get('license') or 'apache-2.0'}\nlibrary_name: lerobot\n"
        "pipeline_tag: robotics\ntags: [LeRobot, tactile, flexitac, vt_dp3]\n---",
        f"# {repo_id.partition('/')[2]}",
        "A visuo-tactile diffusion policy (`vt_dp3` of lerobot_vtrefine) for two-armed insertion; "
        f"{_kind(policy)}.",
        _training(training),
        _success(evaluation),
        _use(repo_id, policy, evaluation),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _settings(path: Path) -> dict[str, Any]:
    found = read_json(path)
    if not isinstance(found, dict):
        raise ValueError(f"{path} does not hold settings")
    return found


def _kind(policy: Mapping[str, Any]) -> str:
    tuned = "fine-tuned by DPPO" if policy.get("ft_denoising_steps") else "trained by imitation"
    return f"it sees {policy.get('modalities', 'visuo_tactile').replace('_', '-')} input and was {tuned}"


def _training(training: Mapping[str, Any]) -> str:
    """Seeds and size of the training, from the settings that checkpoints of both trainers hold."""
    env, dppo, dataset = (training.get(name) or {} for name in ("env", "dppo", "dataset"))
    known = {name: env[name] for name in TASK_FIELDS if env.get(name) is not None}
    lines = []
    if dppo:
        lines.append(
            f"- DPPO preset `{dppo.get('type')}`: {dppo.get('iterations')} iterations of "
            f"{dppo.get('num_envs')} worlds; "
            f"environment seeds from {TRAINING_SEEDS + training.get('seed', 0)} on"
        )
    elif dataset:
        lines.append(
            f"- Imitation of the dataset `{dataset.get('repo_id')}`: {training.get('steps')} steps of "
            f"{training.get('batch_size')} samples, seed {training.get('seed')}"
        )
    if known:
        lines.append(f"- Task: `{json.dumps({'type': env.get('type'), **known})}`")
    note = f"All settings are in `{TRAIN_CONFIG}`."
    return "## Training\n\n" + "\n".join(lines) + f"\n\n{note}" if lines else ""


def _success(evaluation: Path | None) -> str:
    if evaluation is None:
        return "## Success\n\nNot evaluated: nothing is claimed."
    found = load_evaluation(evaluation, first_seed(evaluation / EPISODES))
    lines = [
        "| | |",
        "|---|---|",
        f"| success [95 % Wilson interval] | {percent(found)} |",
        f"| environment seeds | {found['seeds'][0]} to {found['seeds'][-1]} |",
    ]
    for key, words, scale, unit in MEASURED:
        value = found["metrics"]["successes"].get(key)
        if value is not None:
            lines.append(f"| {words}, median of successes | {scale * value['median']:.1f} {unit} |")
    failures = ", ".join(f"{reason} {count}" for reason, count in found["failures"].items()) or "none"
    lines.append(f"| failures by reason | {failures} |")
    return "## Success\n\nIn simulation, by `lerobot-eval`:\n\n" + "\n".join(lines)


def first_seed(path: Path) -> int:
    """The first environment seed of an evaluation's episodes.

    Raises:
        FileNotFoundError: there is no log. ValueError: it holds several evaluations.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no {path}: run lerobot-eval with --env.metrics_path={path}")
    rows = [row for row in read_json_lines(path) if isinstance(row, dict)]
    seeds = sorted({row["seed"] for row in rows if isinstance(row.get("seed"), int)})
    if not seeds or seeds[-1] - seeds[0] >= len(seeds):
        raise ValueError(f"{path} is not of one evaluation: its seeds do not follow each other")
    return seeds[0]


def _use(repo_id: str, policy: Mapping[str, Any], evaluation: Path | None) -> str:
    """The commands that repeat the evaluation, seed by seed."""
    command = evaluation_command(repo_id, policy, evaluation)
    repeats = (
        "The same episodes and, on the same kind of machine, the same successes"
        if "--seed" in command
        else "An evaluation, in the task that `NAME` stands for (`vtrefine configs` lists them)"
    )
    return (
        f"## Use\n\n```bash\npip install 'lerobot_policy_vtrefine[sim]'\n{command}\n```\n\n"
        f"{repeats}, with version {version('lerobot_policy_vtrefine')} of the package."
    )


def evaluation_command(repo_id: str, policy: Mapping[str, Any], evaluation: Path | None) -> str:
    """``lerobot-eval`` of a shared policy: as it was evaluated, where that was noted beside the episodes;
    a policy does not know its task."""
    begin = f"lerobot-eval --policy.path={repo_id} --policy.device={policy.get('device') or 'cpu'}"
    note = None if evaluation is None else read_note(evaluation / EPISODES)
    if evaluation is None or note is None:
        return f"{begin} --config_path=vtrefine:NAME"
    found = load_evaluation(evaluation, first := first_seed(evaluation / EPISODES))
    sizes = (
        f"--eval.n_episodes={found['episodes']}",
        f"--eval.batch_size={note['batch_size']}",
        f"--seed={first}",
    )
    return " \\\n    ".join(
        [begin, *map(shlex.quote, flags("env", {"type": "vtrefine"} | note["env"])), *sizes]
    )
