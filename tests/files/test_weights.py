"""Weights on a full disk: whatever writes them says where there is no room."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.policies import PreTrainedPolicy
from safetensors import SafetensorError

from lerobot_vtrefine.files.weights import naming_full_disk
from lerobot_vtrefine.finetune import state_file
from lerobot_vtrefine.finetune.checkpoint import Saveable
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy

FULL = SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")


def full(*_: Any, **__: Any) -> None:
    raise FULL


def save_state(folder: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(state_file, "save_file", full)
    state_file.save_state({"weights": torch.zeros(3)}, folder / "state.safetensors")


def save_policy(folder: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(PreTrainedPolicy, "_save_pretrained", full)
    VtDp3Policy.__new__(VtDp3Policy)._save_pretrained(folder)


def save_checkpoint(folder: Path, patch: pytest.MonkeyPatch) -> None:
    class Part:
        save_pretrained = staticmethod(full)

    Saveable(*[Part()] * 4).save(folder)


@pytest.mark.parametrize("save", [save_state, save_policy, save_checkpoint])
def test_a_full_disk_is_named(
    save: Callable[[Path, pytest.MonkeyPatch], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OSError, match="free some and run the command again") as told:
        save(tmp_path, monkeypatch)
    assert told.value.errno == errno.ENOSPC
    assert str(told.value.filename).startswith(str(tmp_path))


def test_pythons_own_error_gets_a_name(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="free some") as told, naming_full_disk(tmp_path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert told.value.filename == str(tmp_path)


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full", "the file"), SafetensorError("damaged")])
def test_other_errors_stay_as_they_are(error: Exception, tmp_path: Path) -> None:
    with pytest.raises(type(error)) as told, naming_full_disk(tmp_path):
        raise error
    assert told.value is error
