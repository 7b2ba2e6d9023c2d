"""``vtrefine-share``: upload a dataset or a policy to the Hugging Face Hub, with a card of what it is."""

from collections.abc import Sequence
from pathlib import Path

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.hub import check_upload, is_checkpoint
from lerobot_vtrefine.lerobot_compat.local_places import where_policy_is

DESCRIPTION = """\
Upload a dataset or a policy to the Hugging Face Hub. A policy goes with its processors, without which nobody
can run it, and with a card that holds its success, interval and seeds; a dataset with one that describes its
pads. Log in first: hf auth login."""
EPILOG = """\
examples:
  vtrefine-share outputs/demos --repo_id=USER/demos
  vtrefine-share outputs/finetune/checkpoints/last/pretrained_model --repo_id=USER/insertion \\
      --evaluation=outputs/eval"""


def make_parser() -> CommandParser:
    """Command line of ``vtrefine-share``."""
    parser = CommandParser("vtrefine-share", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="a dataset's root, or a checkpoint's pretrained_model")
    add("--repo_id", required=True, metavar="USER/NAME", help="its name on the Hub")
    add(
        "--evaluation",
        type=Path,
        metavar="DIR",
        help="--output_dir of a lerobot-eval that wrote episodes.jsonl there with --env.metrics_path",
    )
    add("--private", action="store_true", help="only for those whom you invite")
    return parser


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Console entry point."""
    options = make_parser().parse_args(arguments)
    folder = options.folder
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    policy = is_checkpoint(folder)
    if not policy and not (folder / "meta" / "info.json").is_file():
        way_out = where_policy_is(folder) or "name one of them"
        raise ValueError(f"{folder} is neither a LeRobotDataset (meta/info.json) nor a checkpoint: {way_out}")
    if not policy and options.evaluation is not None:
        raise ValueError("--evaluation is about policies; leave it out for a dataset")
    check_upload(options.repo_id)
    from lerobot_vtrefine.cli.sharing import push_dataset, push_policy  # which imports LeRobot

    if policy:
        push_policy(folder, options.repo_id, options.evaluation, private=options.private)
    else:
        push_dataset(folder, options.repo_id, private=options.private)
    print(f"{options.folder} -> {options.repo_id}")


if __name__ == "__main__":
    raise SystemExit(main())
