"""Nested training states as safetensors files: reading them cannot run code, as a pickle's could.

Tensors are stored as such; a JSON text in the file's metadata holds everything else and says where they
belong. What is too much for one file goes on in others beside it: small files can be copied from a machine
that will be gone.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file

from lerobot_vtrefine.files.weights import naming_full_disk

TREE, FILES = "tree", "files"
FILE_BYTES = 15_000_000
"""Tensors in one file, unless a single one is larger."""
Tensors = dict[str, torch.Tensor]


def save_state(state: Any, path: Path, file_bytes: int = FILE_BYTES) -> None:
    """Write dicts, lists and tuples of tensors, numbers, texts and None.

    Raises:
        TypeError: for anything else.
        OSError: the disk is full; names the file.
    """
    tensors: Tensors = {}
    tree = _encode(state, tensors)
    first, *others = _portions(tensors, file_bytes)
    with naming_full_disk(path):
        for number, portion in enumerate(others, start=2):
            save_file(portion, _file(path, number))
        save_file(first, path, metadata={TREE: json.dumps(tree), FILES: str(1 + len(others))})


def load_state(path: Path) -> Any:
    """What ``save_state`` wrote, with all tensors on the CPU.

    Raises:
        ValueError: the file is damaged, or not of this kind.
    """
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no dict
            notes = file.metadata() or {}
        for number in range(2, int(notes[FILES]) + 1):
            tensors |= load_file(_file(path, number))
        return _decode(json.loads(notes[TREE]), tensors)
    except (SafetensorError, FileNotFoundError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged or no training state: {error}") from error


def _file(path: Path, number: int) -> Path:
    return path.with_stem(f"{path.stem}-{number}")


def _portions(tensors: Tensors, file_bytes: int) -> list[Tensors]:
    """The tensors in their order, as much in each file as it may hold; at least one file."""
    portions: list[Tensors] = [{}]
    room = file_bytes
    for name, tensor in tensors.items():
        size = tensor.numel() * tensor.element_size()
        if size > room and portions[-1]:
            portions.append({})
            room = file_bytes
        portions[-1][name] = tensor
        room -= size
    return portions


def _encode(value: Any, tensors: Tensors) -> Any:
    if isinstance(value, torch.Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().clone().contiguous()
        return {"tensor": name}
    if isinstance(value, dict):
        return {"dict": [[key, _encode(item, tensors)] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_encode(item, tensors) for item in value]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a training state cannot hold a {type(value).__name__}")


def _decode(value: Any, tensors: Tensors) -> Any:
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "tensor":
        return tensors[content]
    if kind == "dict":
        return {key: _decode(item, tensors) for key, item in content}
    items = [_decode(item, tensors) for item in content]
    return tuple(items) if kind == "tuple" else items
