"""What a checkpoint's processor files may name, checked before any of it is imported or run.

LeRobot builds each step of ``policy_preprocessor.json`` and ``policy_postprocessor.json`` from a name in the
file: one of its registry, or any dotted path, which it imports and calls with the file's arguments, so that
``{"class": "subprocess.Popen", "config": {"args": [...]}}`` runs a command. ``install`` puts a check between
reading such a file and building its steps, in every command that loads this package:

- whatever the policy, a step must be a subclass of ``ProcessorStep``, which LeRobot itself finds out only
  after the call;
- once the process has made a configuration of ``vt_dp3`` (``restrict``), every step must also be registered,
  or be a class of LeRobot's own processors or of this package, and must load nothing by a name in the file;
  state files are safetensors beside the file. It is the configuration that counts and not the folder's
  ``config.json``, because who writes a checkpoint may let its files say different things.

Other policies' files may go on naming processor steps in packages of their own, and tokenizers, also in a
process that has used ``vt_dp3`` before: where LeRobot makes a policy's processors, that policy's type counts.
"""

import functools
import sys
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

from lerobot.processor import pipeline
from lerobot.processor.pipeline import DataProcessorPipeline, ProcessorStep, ProcessorStepRegistry

POLICY = "vt_dp3"
FACTORY, MAKE = "lerobot.policies.factory", "make_pre_post_processors"
OWN_PACKAGE = "lerobot_vtrefine"
LEROBOT = "lerobot"
OPEN_PACKAGES = ("lerobot.processor", OWN_PACKAGE)
"""Packages whose processor steps a checkpoint of ``vt_dp3`` may name by their dotted path."""
LOADERS = frozenset(
    {"TokenizerProcessorStep", "ActionTokenizerProcessorStep", "RewardClassifierProcessorStep"}
)
"""LeRobot's steps that load models or tokenizers, code included, by a name in the file."""
STATE_SUFFIX = ".safetensors"

_validate = DataProcessorPipeline._validate_loaded_config.__func__
_restricted = False
_policy: ContextVar[str | None] = ContextVar("policy whose processors LeRobot makes", default=None)


def install() -> None:
    """Check every processor file that LeRobot reads in this process from now on. Idempotent."""

    def checked(cls: Any, model_id: str, loaded_config: Any, config_filename: str) -> None:
        _validate(cls, model_id, loaded_config, config_filename)
        check_steps(cls, loaded_config["steps"], f"{config_filename} of {model_id}")

    pipeline.DataProcessorPipeline._validate_loaded_config = classmethod(checked)  # ty: ignore[invalid-assignment]


def restrict() -> None:
    """Allow processor files from now on only what one of ``vt_dp3`` may name, but those that LeRobot reads to
    make another policy's processors.
    """
    global _restricted
    _restricted = True
    stock = getattr(sys.modules.get(FACTORY), MAKE, None)
    if stock is None or hasattr(stock, "__wrapped__"):
        return
    ours = _for_its_policy(stock)
    for name, module in list(sys.modules.items()):
        holds_it = vars(module).get(MAKE) is stock
        if holds_it and (name == "__main__" or name.startswith(f"{LEROBOT}.")):
            setattr(module, MAKE, ours)


def _for_its_policy[**P, R](stock: Callable[P, R]) -> Callable[P, R]:
    @functools.wraps(stock)
    def make(*args: P.args, **kwargs: P.kwargs) -> R:
        config: Any = args[0] if args else kwargs.get("policy_cfg")
        outer = _policy.set(getattr(config, "type", None))
        try:
            return stock(*args, **kwargs)
        finally:
            _policy.reset(outer)

    return make


def is_restricted() -> bool:
    """Whether a processor file that is read now may name only what one of ``vt_dp3`` may."""
    return _restricted and _policy.get() in (None, POLICY)


def check_steps(cls: type[DataProcessorPipeline], steps: list[dict[str, Any]], file: str) -> None:
    """Raise ValueError, naming ``file`` and the class, for the first of ``steps`` that must not be built."""
    if is_restricted():
        for number, step in enumerate(steps):  # all of them before the first is imported
            if reason := forbidden_entry(step):
                raise ValueError(f"{file}: step {number} {reason}; nothing of it was run")
    for number, step in enumerate(steps):
        step_class, name = cls._resolve_step_class(step)
        reason = None
        if not (isinstance(step_class, type) and issubclass(step_class, ProcessorStep)):
            reason = f"names {step.get('class', name)!r}, which is not a processor step"
        elif is_restricted():
            reason = forbidden_class(step_class)
        if reason is not None:
            raise ValueError(f"{file}: step {number} {reason}; nothing of it was run")


def forbidden_entry(step: dict[str, Any]) -> str | None:
    """Why a step of a ``vt_dp3`` checkpoint must not even be imported, from what the file says; or None."""
    state_file = step.get("state_file")
    if state_file is not None and not _is_plain_state_file(state_file):
        return f"names the state file {state_file!r}, which is not a {STATE_SUFFIX} file beside this one"
    if not isinstance(step.get("config", {}), dict):
        return "has a config that is not a mapping of argument names to values"
    if "registry_name" in step:
        name = step["registry_name"]
        known = isinstance(name, str) and name in ProcessorStepRegistry.list()
        return None if known else f"names {name!r}, which is not a registered processor step"
    path = step["class"]
    is_path = isinstance(path, str) and all(part.isidentifier() for part in path.split("."))
    if is_path and any(path.startswith(f"{package}.") for package in OPEN_PACKAGES):
        return None
    return (
        f"names the class {path!r}; vt_dp3 loads registered processor steps and classes of"
        f" {' and '.join(OPEN_PACKAGES)} only"
    )


def forbidden_class(step_class: type) -> str | None:
    """Why a ``vt_dp3`` checkpoint must not use an importable step; or None.

    LeRobot's steps for other policies, rewards and robots load models and tokenizers by name, some with code
    from there. Registered steps of other installed plugins are theirs to answer for.
    """
    for base in step_class.__mro__:
        inside = any(f"{base.__module__}.".startswith(f"{package}.") for package in OPEN_PACKAGES)
        if base.__module__.split(".")[0] == LEROBOT and (not inside or base.__name__ in LOADERS):
            return (
                f"is {step_class.__module__}.{step_class.__name__}, which vt_dp3 never uses and which may"
                " load other files or code by a name in this one"
            )
    return None


def _is_plain_state_file(name: Any) -> bool:
    return (
        isinstance(name, str)
        and name.endswith(STATE_SUFFIX)
        and not any(mark in name for mark in ("/", "\\", "\0"))
        and name != STATE_SUFFIX
    )
