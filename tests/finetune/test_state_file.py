"""Training states in files that are small enough to be copied one by one."""

from pathlib import Path

import pytest
import torch

from lerobot_vtrefine.finetune.state_file import load_state, save_state

STATE = {
    "weights": [torch.arange(10.0), torch.ones(30), torch.zeros(4, dtype=torch.long)],
    3: ("text", None, True, 0.5, torch.full((7,), 2.0)),
}


@pytest.mark.parametrize(("file_bytes", "files"), [(10_000, 1), (160, 2), (100, 3), (1, 4)])
def test_a_state_comes_back_from_as_many_files_as_it_needs(
    tmp_path: Path, file_bytes: int, files: int
) -> None:
    save_state(STATE, tmp_path / "state.safetensors", file_bytes)
    assert len(list(tmp_path.iterdir())) == files
    loaded = load_state(tmp_path / "state.safetensors")
    torch.testing.assert_close(loaded["weights"], STATE["weights"], rtol=0, atol=0)
    assert loaded[3][:4] == STATE[3][:4]
    torch.testing.assert_close(loaded[3][4], STATE[3][4], rtol=0, atol=0)


def test_small_files_hold_what_fits_and_large_tensors_stand_alone(tmp_path: Path) -> None:
    save_state(STATE, tmp_path / "state.safetensors", file_bytes=100)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "state-2.safetensors",  # 120 bytes: larger than a file should be
        "state-3.safetensors",  # 32 and 28
        "state.safetensors",  # 40
    ]


def test_a_lost_file_is_one_line(tmp_path: Path) -> None:
    save_state(STATE, tmp_path / "state.safetensors", file_bytes=100)
    (tmp_path / "state-3.safetensors").unlink()
    with pytest.raises(ValueError, match=r"damaged or no training state: .*state-3"):
        load_state(tmp_path / "state.safetensors")


def test_training_state_comes_back_exactly_and_is_no_pickle(tmp_path):
    state = {
        0: {"step": torch.tensor(3.0), "betas": (0.9, 0.999)},
        "weights": [torch.rand(2, 3).T, torch.zeros(0, dtype=torch.uint8)],
        "rest": [None, True, 7, 1 / 3, float("-inf"), "text", []],
    }
    path = tmp_path / "state.safetensors"
    save_state(state, path)
    loaded = load_state(path)
    rest = state.pop("rest")
    assert loaded.pop("rest") == rest
    torch.testing.assert_close(loaded, state, rtol=0, atol=0)
    assert loaded[0]["betas"] == (0.9, 0.999)
    with pytest.raises(TypeError, match="Path"):
        save_state({"x": tmp_path}, path)
