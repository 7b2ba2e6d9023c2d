"""``vtrefine-policy-server``: serve a policy to robots elsewhere, by LeRobot's asynchronous inference."""

from collections.abc import Sequence

from lerobot_vtrefine.choices import check_port
from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.extras import ASYNCHRONOUS, require

DESCRIPTION = """\
LeRobot's policy server with vt_dp3 in it: a robot's computer sends observations, pads included, and gets
chunks of actions. Which checkpoint, and on which device, the client says. The server reads pickled Python
objects, as LeRobot's does: let only machines that you trust reach it."""
EPILOG = """\
example:
  vtrefine-policy-server --port=8080
and on the robot's computer LeRobot's own client:
  python -m lerobot.async_inference.robot_client --robot.type=vtrefine_sim --fps=10 \\
      --server_address=127.0.0.1:8080 --policy_type=vt_dp3 --pretrained_name_or_path=CHECKPOINT \\
      --actions_per_chunk=8 --aggregate_fn_name=latest_only"""


def make_parser() -> CommandParser:
    """Command line of ``vtrefine-policy-server``."""
    parser = CommandParser("vtrefine-policy-server", DESCRIPTION, EPILOG)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (default: %(default)s)")
    parser.add_argument("--port", type=int, default=8080, help="port to listen on (default: %(default)s)")
    parser.add_argument("--fps", type=int, default=10, help="actions per second (default: %(default)s)")
    return parser


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Console entry point."""
    options = make_parser().parse_args(arguments)
    check_port("--port", options.port)
    if options.fps < 1:
        raise ValueError(f"--fps must be at least 1, got {options.fps}")
    require("vtrefine-policy-server", ASYNCHRONOUS)
    from lerobot_vtrefine import register
    from lerobot_vtrefine.lerobot_compat.policy_server import start

    register()
    server = start(options.host, options.port, options.fps)
    print(f"listening at {options.host}:{options.port}; Ctrl-C ends it", flush=True)
    try:
        server.wait_for_termination()
    finally:
        server.stop(grace=None)


if __name__ == "__main__":
    raise SystemExit(main())
