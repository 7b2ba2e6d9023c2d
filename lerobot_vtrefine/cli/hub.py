"""What can be said about an upload before anything is made: its name, and whether somebody is logged in."""

from pathlib import Path

LOCAL = "local"
"""The user of datasets that never leave this machine."""


def check_upload(repo_id: str) -> None:
    """ValueError unless it is a name on the Hub, and this machine is logged in there."""
    user, slash, name = repo_id.partition("/")
    if not (user and slash and name) or "/" in name or user == LOCAL:
        raise ValueError(f"--repo_id={repo_id}: give a name on the Hub, such as USER/insertion")
    from huggingface_hub import get_token

    if get_token() is None:
        raise ValueError("nobody is logged in to the Hugging Face Hub here: run hf auth login first")


def is_checkpoint(folder: Path) -> bool:
    """Whether the folder holds a policy rather than a dataset."""
    return (folder / "config.json").is_file() and not (folder / "meta" / "info.json").is_file()
