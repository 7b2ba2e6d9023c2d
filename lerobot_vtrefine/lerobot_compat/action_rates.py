"""Says before LeRobot's commands begin that a policy would be played at another rate than it learned.

Its chunks would be played faster or slower than they were recorded, in simulation or by real arms, and
nothing but a low success rate would tell: ``lerobot-rollout`` takes 30 actions a second by default,
and ``lerobot-train`` evaluates at any. ``lerobot-eval`` gives the policy the environment's features, so the
policy refuses by itself there; in ``lerobot-train`` it is given the dataset's. The client of asynchronous
inference knows no more of its policy than a name that another computer may read, so it tells its rate to that
computer, whose ``vtrefine-policy-server`` compares them.
"""

import functools
from collections.abc import Callable
from typing import Any, NoReturn, cast

from lerobot_vtrefine.lerobot_compat.guard import is_supported
from lerobot_vtrefine.lerobot_compat.phases import PhasedRobot, loaded_modules

TRAINING = "lerobot.scripts.lerobot_train"
ROLLOUT = "lerobot.scripts.lerobot_rollout"
CLIENT = "lerobot.async_inference.robot_client"
RATE = "vtrefine-fps"
"""What the client's rate is called where it is sent to the server."""
ENVIRONMENT = "vtrefine"


def install() -> None:
    """Check what LeRobot's commands open in this process from now on. Idempotent."""
    if not is_supported():
        return
    for module in loaded_modules(TRAINING):
        _wrap(module, "make_train_eval_datasets", _checked_training)
    for module in loaded_modules(ROLLOUT):
        _wrap(module, "build_rollout_context", _checked_rollout)
    for module in loaded_modules(CLIENT):
        _wrap(module.RobotClient, "start", _checked_client)


def _wrap(owner: Any, name: str, checked: Callable[[Any], Any]) -> None:
    if not hasattr(getattr(owner, name), "__wrapped__"):
        setattr(owner, name, checked(getattr(owner, name)))


def _checked_training(stock: Any) -> Any:
    @functools.wraps(stock)
    def checked(cfg: Any) -> Any:
        found = stock(cfg)
        if cfg.env_eval_freq > 0:
            check_rate(cfg.env, found[0].meta.fps)
        return found

    return checked


def _checked_rollout(stock: Any) -> Any:
    @functools.wraps(stock)
    def checked(cfg: Any, *args: Any, **settings: Any) -> Any:
        if hasattr(cfg.policy, "check_fps"):
            try:
                cfg.policy.check_fps(cfg.fps, "--fps")
            except ValueError as error:
                raise SystemExit(f"error: {error}") from error
        return stock(cfg, *args, **settings)

    return checked


def _checked_client(stock: Any) -> Any:
    """``start`` of a client, whose robot is connected, and still."""

    @functools.wraps(stock)
    def checked(client: Any) -> Any:
        import grpc

        def send(setup: Any) -> Any:
            try:
                return stock_send(setup, metadata=((RATE, f"{fps:g}"),))
            except grpc.RpcError as error:
                call = cast("grpc.Call", error)  # as grpc raises it
                if call.code() is grpc.StatusCode.FAILED_PRECONDITION:  # this package's server refused
                    refuse(client, call.details())
                raise

        fps, stock_send = client.config.fps, client.stub.SendPolicyInstructions
        client.stub.SendPolicyInstructions = send
        if isinstance(client.robot, PhasedRobot):
            try:
                client.robot.check_rate(fps)
            except ValueError as error:
                refuse(client, str(error))
        return stock(client)

    def refuse(client: Any, why: str) -> NoReturn:
        client.stop()
        raise SystemExit(f"error: {why}")

    return checked


def check_rate(env: Any, fps: int) -> None:
    """Compare an environment's configuration, or None, with a dataset's frames a second.

    Raises:
        SystemExit: it is an environment of this package and takes actions at another rate.
    """
    if env is not None and env.type == ENVIRONMENT and env.fps != fps:
        raise SystemExit(
            f"error: --env.fps={env.fps}, but the dataset holds {fps:g} actions a second: give"
            f" --env.fps={fps:g}"
        )
