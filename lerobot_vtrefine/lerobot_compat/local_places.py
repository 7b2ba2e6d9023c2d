"""Names in one line the folder that LeRobot's commands would ask the Hub for, as after a typo.

LeRobot ends in a hundred lines about the network then, or about a name that no Hub would take.
"""

import json
import sys
from pathlib import Path

LOCAL = "local/"
"""Names of datasets that are on no Hub."""
NEEDED = {"lerobot-train": "data", "lerobot-replay": "data", "lerobot-record": "meta"}
"""By command that reads a dataset, the last one with ``--resume=true`` alone, the folder it must have."""
YES = ("true", "yes", "y", "on", "1")
TAKING_POLICIES = ("lerobot-train", "lerobot-eval", "lerobot-rollout")
POLICY_PATH = "--policy.path"
CONFIG = "config.json"
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
BELOW = ("pretrained_model", "checkpoints/last/pretrained_model")
"""Where a policy lies in the folder of a checkpoint, and of a run."""


def refuse_missing_places() -> None:
    """Check this process's own command line.

    Raises:
        SystemExit: a dataset or a policy is not where it is said to be.
    """
    command, given = Path(sys.argv[0]).name, dict(text.partition("=")[::2] for text in sys.argv[1:])
    problem = missing_dataset(command, given)
    if command in TAKING_POLICIES and POLICY_PATH in given:
        problem = problem or missing_policy(given[POLICY_PATH])
    if problem:
        raise SystemExit(f"error: {problem}")


def missing_dataset(command: str, given: dict[str, str]) -> str:
    """Which dataset of this machine the flags of ``command`` name though its folder holds none; or nothing.

    Where a file of settings is named, too, the folder must be named beside it, as the file may do so.
    """
    root, name = given.get("--dataset.root"), given.get("--dataset.repo_id", "")
    told = root or "--config_path" not in given
    reads = command != "lerobot-record" or given.get("--resume", "").lower() in YES
    if not (name.startswith(LOCAL) and command in NEEDED and reads and told):
        return ""
    from lerobot.utils.constants import HF_LEROBOT_HOME

    folder = Path(root or HF_LEROBOT_HOME / name) / NEEDED[command]
    if folder.is_dir():
        return ""
    where = f"--dataset.root={root}" if root else f"{folder.parent} (no --dataset.root was given)"
    return f"{where} holds no recorded episodes: there is no {folder}"


def missing_policy(given: str) -> str:
    """Why ``--policy.path=GIVEN`` is no policy of any type, here or on the Hub; nothing where it is one."""
    if Path(given).exists():
        return misnamed_policy(Path(given))
    told = f"{POLICY_PATH}={given}: there is no such folder"
    if not may_be_on_the_hub(given):
        return f"{told}; name a checkpoint's pretrained_model"
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import RemoteEntryNotFoundError, RepositoryNotFoundError

    silent = f"{told}, and the Hub, where it may be, does not answer"
    if is_out_of_reach(given):
        return silent
    try:
        hf_hub_download(given, CONFIG)  # as LeRobot does next
    except (RepositoryNotFoundError, RemoteEntryNotFoundError):
        return f"{told}, and the Hub has no policy of this name that this account may read"
    except (OSError, ValueError):
        return silent
    return ""


def is_out_of_reach(name: str) -> bool:
    """Whether a policy of the Hub is not in the cache, and no connection can be made.

    One question tells it at once; a download asks for half a minute.
    """
    import httpx
    from huggingface_hub import get_hf_file_metadata, hf_hub_url, try_to_load_from_cache

    try:
        if not isinstance(try_to_load_from_cache(name, CONFIG), str):
            get_hf_file_metadata(hf_hub_url(name, CONFIG))
    except httpx.ConnectError:
        return True
    except (httpx.HTTPError, OSError, ValueError):
        pass  # of which the download tells more
    return False


def misnamed_policy(folder: Path) -> str:
    """Which folder to take where one that is there is not a policy's own, or what is wrong with its
    settings; nothing where it is a policy's.
    """
    if (folder / CONFIG).is_file():
        return damaged_settings(folder)
    way_out = where_policy_is(folder) or "name a checkpoint's pretrained_model"
    return f"{POLICY_PATH}={folder} is not a policy's own folder: {way_out}"


def damaged_settings(folder: Path) -> str:
    """Which settings of a policy's own folder cannot be read, of which LeRobot tells no file; or nothing."""
    for file in (CONFIG, *PROCESSORS):
        if not (folder / file).is_file():
            continue
        try:
            settings = json.loads((folder / file).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            return f"{folder}: {file} is not valid JSON ({error})"
        if not isinstance(settings, dict):
            return f"{folder}: {file} does not hold settings by name"
    return ""


def where_policy_is(folder: Path) -> str:
    """What to take in place of the folder of a checkpoint or of a run; empty where it is neither."""
    inside = [folder / below for below in BELOW if (folder / below / CONFIG).is_file()]
    return f"take {inside[0]}" if inside else ""


def may_be_on_the_hub(name: str) -> bool:
    """Whether it reads as USER/NAME."""
    user, slash, rest = name.partition("/")
    return bool(slash and rest) and "/" not in rest and not user.startswith((".", "~")) and user != ""
