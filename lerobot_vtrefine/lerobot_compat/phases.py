"""Tells robots and teleoperators when LeRobot's loops begin and end an episode, or the time between two.

LeRobot 0.6.1's robots see observations and actions only. Real ones need no more, because a person puts the
parts back; a simulated one must know when to start anew, and can end an episode itself. `install` wraps the
loops of ``lerobot-record`` and of the episodic strategy of ``lerobot-rollout``. Teleoperators that solve for
joint positions themselves must know where the joints are when a loop begins, that of ``lerobot-teleoperate``
included. A policy in ``lerobot-rollout`` without recording must forget what it planned for the last episode.
A simulated robot must also know at which rate it is driven, by ``lerobot-replay`` as well.
Robots without ``phase`` and teleoperators without ``follow`` see nothing of it.
"""

import functools
import sys
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any, Protocol, runtime_checkable

from lerobot_vtrefine.lerobot_compat.guard import is_supported

LOOPS = (
    ("lerobot.scripts.lerobot_record", None, "record_loop"),
    ("lerobot.scripts.lerobot_teleoperate", None, "teleop_loop"),
    ("lerobot.rollout.strategies.base", "BaseStrategy", "run"),
    ("lerobot.rollout.strategies.episodic", "EpisodicStrategy", "_policy_loop"),
    ("lerobot.rollout.strategies.episodic", "EpisodicStrategy", "_reset_loop"),
)
"""Module, class and name of each function that runs one phase of a recording."""
REPLAY = "lerobot.scripts.lerobot_replay"


@runtime_checkable
class PhasedRobot(Protocol):
    """A robot that wants to know."""

    def check_rate(self, fps: float) -> None:
        """Raises: ValueError where the robot cannot be driven at a loop's rate [Hz]."""
        ...

    def phase(self, events: dict[str, bool], dataset: Any | None) -> AbstractContextManager[None]:
        """Entered where a phase begins and left where it ends.

        Args:
            events: LeRobot's keys; setting ``exit_early`` ends the phase.
            dataset: what the episode is recorded into; None between two episodes.
        """
        ...


@runtime_checkable
class FollowingTeleoperator(Protocol):
    """A teleoperator that goes on from where the robot is."""

    def follow(self, positions: Mapping[str, float], fps: float) -> None:
        """The robot's joint positions by their action keys, and the loop's rate [Hz]."""
        ...


@runtime_checkable
class HoldingRobot(Protocol):
    """A robot that says where its servos hold the joints: under a load these are elsewhere. It may begin
    another episode by itself.
    """

    on_restart: Callable[[], None] | None
    """To be called when it has."""

    def held_targets(self) -> Mapping[str, float]:
        """Joint targets by their action keys."""
        ...


def install() -> None:
    """Wrap the loops that are loaded; idempotent, also picks up what has been loaded since.

    Raises: RuntimeError on a LeRobot version whose loops were not tested with this.
    """
    if not is_supported():
        raise RuntimeError(
            "a simulated robot needs lerobot >=0.6.1,<0.7: its recording loops are hooked into"
        )
    for owner, name in _loaded():
        loop = vars(owner)[name]
        if not hasattr(loop, "unphased"):
            setattr(owner, name, (_forgetting if name == "run" else _phased)(loop))


def watch_replay(robot: PhasedRobot) -> None:
    """Let the robot that ``lerobot-replay`` makes now check the rate of the dataset that this opens next.

    Once: another robot that is replayed later in this process is none of this one's business.
    """
    for module in loaded_modules(REPLAY):
        _unwatch(module)
        make, open_ = module.make_robot_from_config, module.LeRobotDataset

        def made(*args: Any, module: Any = module, make: Any = make) -> Any:
            _unwatch(module)
            return make(*args)

        def opened(*args: Any, module: Any = module, open_: Any = open_, **settings: Any) -> Any:
            _unwatch(module)
            dataset = open_(*args, **settings)
            robot.check_rate(dataset.fps)
            return dataset

        made.unphased, opened.unphased = make, open_  # ty: ignore[missing-attribute]
        module.make_robot_from_config, module.LeRobotDataset = made, opened


def _unwatch(module: Any) -> None:
    for name in ("make_robot_from_config", "LeRobotDataset"):
        _restore(module, name)


def uninstall() -> None:
    """Restore LeRobot's own loops."""
    for owner, name in _loaded():
        _restore(owner, name)
    for module in loaded_modules(REPLAY):
        _unwatch(module)


def _restore(owner: Any, name: str) -> None:
    loop = vars(owner)[name]
    setattr(owner, name, getattr(loop, "unphased", loop))


def loaded_modules(name: str) -> list[Any]:
    """A module that is loaded, also as the script that runs."""
    main = sys.modules["__main__"]
    modules = [sys.modules[name]] if name in sys.modules else []
    if getattr(getattr(main, "__spec__", None), "name", None) == name:
        modules.append(main)
    return modules


def _loaded() -> Iterator[tuple[Any, str]]:
    """Module or class, and name, of every loop whose module is loaded."""
    for module_name, class_name, name in LOOPS:
        for module in loaded_modules(module_name):
            yield (module if class_name is None else getattr(module, class_name)), name


@contextmanager
def _followed(robot: Any, teleop: FollowingTeleoperator, fps: float) -> Generator[None]:
    """The teleoperator goes on from where the robot is, now and whenever the robot starts anew by itself."""

    def follow() -> None:
        held = robot.held_targets() if isinstance(robot, HoldingRobot) else robot.get_observation()
        teleop.follow({key: held[key] for key in robot.action_features}, fps)

    follow()
    if not isinstance(robot, HoldingRobot):
        yield
        return
    robot.on_restart = follow
    try:
        yield
    finally:
        robot.on_restart = None


def _forgetting(run: Callable[..., None]) -> Callable[..., None]:
    """A rollout whose policy is reset whenever the robot starts anew by itself."""

    @functools.wraps(run)
    def wrapper(strategy: Any, ctx: Any) -> None:
        robot = getattr(ctx.hardware.robot_wrapper, "inner", ctx.hardware.robot_wrapper)
        if not isinstance(robot, HoldingRobot):
            return run(strategy, ctx)

        if isinstance(robot, PhasedRobot):
            robot.check_rate(ctx.runtime.cfg.fps * ctx.runtime.cfg.interpolation_multiplier)

        def forget() -> None:
            strategy._engine.reset()
            strategy._interpolator.reset()

        robot.on_restart = forget
        try:
            return run(strategy, ctx)
        finally:
            robot.on_restart = None

    wrapper.unphased = run  # ty: ignore[missing-attribute]
    return wrapper


def _phased(loop: Callable[..., None]) -> Callable[..., None]:
    """The loop, inside the robot's phase; LeRobot passes all of its arguments by name.

    A script that passes another robot otherwise sees nothing of it.

    Raises:
        TypeError: a robot or a teleoperator that wants to know is not passed by name.
    """

    @functools.wraps(loop)
    def run(*args: Any, **settings: Any) -> None:
        if any(isinstance(given, PhasedRobot | FollowingTeleoperator) for given in args):
            raise TypeError("LeRobot's loop needs its arguments by name here: robot=, teleop=, fps=, ...")
        if "robot" not in settings:
            return loop(*args, **settings)
        robot = getattr(settings["robot"], "inner", settings["robot"])
        with ExitStack() as stack:
            if isinstance(robot, PhasedRobot):
                robot.check_rate(settings["fps"])
                if "events" in settings:
                    stack.enter_context(robot.phase(settings["events"], settings.get("dataset")))
            if isinstance(teleop := settings.get("teleop"), FollowingTeleoperator):
                stack.enter_context(_followed(robot, teleop, settings["fps"]))
            return loop(*args, **settings)

    run.unphased = loop  # ty: ignore[missing-attribute]
    return run
