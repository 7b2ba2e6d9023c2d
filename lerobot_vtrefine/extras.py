"""Optional dependencies: which extra installs which module, and what to say where one is missing."""

import importlib.util

EXTRA_OF = {
    "mujoco": "sim",
    "warp": "sim",
    "mujoco_warp": "gpu",
    "mjviser": "view",
    "viser": "view",
    "mink": "teleop",
    "daqp": "teleop",
    "pyspacemouse": "spacemouse",
    "grpc": "async",
    "serial": "hardware",
    "dynamixel_sdk": "hardware",
    "deepdiff": "hardware",
    "trimesh": "assets",
    "manifold3d": "assets",
}
"""Extra by the name under which a module is imported; LeRobot's motor buses compare settings by deepdiff."""

SIMULATOR = ("mujoco", "warp")
VIEW = ("mujoco", "warp", "mjviser")
ASYNCHRONOUS = ("grpc",)
TELEOPERATION = ("mujoco", "warp", "mink", "daqp")
SPACEMOUSE = ("pyspacemouse",)
PADS = ("serial",)
ARMS = ("serial", "dynamixel_sdk", "deepdiff")


class MissingExtraError(ImportError):
    """Something needs an extra that is not installed; the message names it and how to install it."""


def require(what: str, modules: tuple[str, ...]) -> None:
    """Check that modules are installed before ``what`` needs them; imports nothing.

    Raises:
        MissingExtraError: one of them cannot be found.
    """
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingExtraError(_advice(what, EXTRA_OF[missing[0]], ", ".join(missing)))


def explain(error: ModuleNotFoundError) -> str | None:
    """Which extra would have brought the module that an import did not find; None for any other module."""
    name = error.name or ""
    extra = EXTRA_OF.get(name.partition(".")[0])
    return None if extra is None else _advice("this", extra, name)


def _advice(what: str, extra: str, missing: str) -> str:
    return (
        f"{what} needs the extra [{extra}] ({missing} not found): "
        f"pip install 'lerobot_policy_vtrefine[{extra}]'"
    )
