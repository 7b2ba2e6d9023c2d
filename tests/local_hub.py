"""A Hub that is a folder: what LeRobot uploads lands there, what it downloads comes from there."""

import shutil
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
from huggingface_hub import DatasetCard
from huggingface_hub.utils import filter_repo_objects


def copy(source: Path, target: Path, allow: Any, ignore: Any) -> None:
    """Copies the files that the Hub's own patterns select."""
    files = (path.relative_to(source).as_posix() for path in source.rglob("*") if path.is_file())
    for name in filter_repo_objects(files, allow_patterns=allow, ignore_patterns=ignore):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / name, target / name)


class FolderApi:
    """The calls of `HfApi` that pushing a dataset or a policy makes."""

    hub: Path

    def create_repo(self, repo_id: str, **_: Any) -> None:
        (self.hub / repo_id).mkdir(parents=True, exist_ok=True)

    def upload_folder(
        self, repo_id: str, folder_path: Path, allow_patterns: Any, ignore_patterns: Any, **_: Any
    ) -> None:
        copy(Path(folder_path), self.hub / repo_id, allow_patterns, ignore_patterns)

    def delete_tag(self, *_: Any, **__: Any) -> None: ...

    def create_tag(self, *_: Any, **__: Any) -> None: ...


def use_folder_as_hub(patch: pytest.MonkeyPatch, hub: Path) -> None:
    """Redirects pushing and pulling of datasets, and pushing of policies."""
    from lerobot.datasets import dataset_metadata, lerobot_dataset

    def snapshot_download(repo_id: str, **options: Any) -> str:
        target = Path(options.get("local_dir") or options["cache_dir"])
        copy(hub / repo_id, target, options.get("allow_patterns"), options.get("ignore_patterns"))
        return str(target)

    def push_card(card: DatasetCard, repo_id: str, **_: Any) -> None:
        card.save(hub / repo_id / "README.md")

    patch.setenv("HF_TOKEN", "of nobody")
    api = type("Api", (FolderApi,), {"hub": hub})
    patch.setattr(huggingface_hub, "HfApi", api)
    patch.setattr(lerobot_dataset, "HfApi", api)
    patch.setattr(DatasetCard, "push_to_hub", push_card)
    for module in (dataset_metadata, lerobot_dataset):
        patch.setattr(module, "snapshot_download", snapshot_download)
        patch.setattr(module, "get_safe_version", lambda repo_id, revision, **_: revision)
