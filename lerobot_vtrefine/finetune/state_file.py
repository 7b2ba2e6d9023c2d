"""Nested training states as one safetensors file: reading it cannot run code, as a pickle's could.

Tensors are stored as such; a JSON text in the file's metadata holds everything else and says where they
belong.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

TREE = "tree"
Tensors = dict[str, torch.Tensor]


def save_state(state: Any, path: Path) -> None:
    """Write dicts, lists and tuples of tensors, numbers, texts and None; TypeError for anything else."""
    tensors: Tensors = {}
    tree = _encode(state, tensors)
    save_file(tensors, path, metadata={TREE: json.dumps(tree)})


def load_state(path: Path) -> Any:
    """What ``save_state`` wrote, with all tensors on the CPU.

    Raises:
        ValueError: the file is damaged, or not of this kind.
    """
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no dict
            return _decode(json.loads((file.metadata() or {})[TREE]), tensors)
    except (SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged or no training state: {error}") from error


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
