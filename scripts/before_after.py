"""A moving picture of two policies in the same episodes, side by side and in step.

    python scripts/before_after.py --config_path=configs/env/square_grasped_1mm.yaml \\
        --before=outputs/square/pretrain/checkpoints/last/pretrained_model \\
        --after=lerobot_vtrefine/assets/policies/square_grasped_1mm --output=docs/img/demo.gif

Episodes are those of the seeds 0, 1, 2 ... unless --seed says otherwise: nothing is picked.
"""

from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import draccus
from PIL import Image, ImageDraw

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_file
from lerobot_vtrefine.cli.playing.agents import PolicyAgent
from lerobot_vtrefine.cli.report.gif import write_gif
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.live_world import LiveWorld
from lerobot_vtrefine.files import read_yaml
from lerobot_vtrefine.sim.appearance import PLUG_COLOUR, SOCKET_COLOUR
from lerobot_vtrefine.sim.render import VideoRenderer

GROUND, INK = (24, 26, 32), (226, 228, 232)
TITLE_PX, FONT_PX, GAP_PX = 34, 20, 10
FRAME_MS = 200
EVERY = 2
"""Control steps from one picture to the next."""


def filmed(policy: str, env: VtRefineEnvConfig, seeds: range) -> Iterator[list[Image.Image]]:
    """The pictures of every episode of a policy, its last one always among them."""
    world, agent = LiveWorld(env), PolicyAgent(policy, env, "cpu")
    renderer = VideoRenderer(world.sim, menagerie_dir=world.config.menagerie_dir)
    for seed in seeds:
        world.reset(seed)
        agent.reset(world)
        frames = []
        while not world.outcome:
            targets = agent.act(world)
            assert targets is not None  # a policy always acts
            world.step(targets)
            world.observe()
            if world.outcome or world.steps % EVERY == 0:
                frames.append(Image.fromarray(renderer.frame()))
        print(f"{policy}, seed {seed}: {world.outcome} after {world.steps} steps", flush=True)
        yield frames
    renderer.close()


def side_by_side(left: Image.Image, right: Image.Image, titles: tuple[str, str], width: int) -> Image.Image:
    """Two pictures of one size under their titles, `width` pixels wide together."""
    joined = Image.new("RGB", (left.width + right.width + GAP_PX, left.height + TITLE_PX), GROUND)
    draw = ImageDraw.Draw(joined)
    for offset, picture, title in ((0, left, titles[0]), (left.width + GAP_PX, right, titles[1])):
        joined.paste(picture, (offset, TITLE_PX))
        draw.text((offset + GAP_PX, 6), title, fill=INK, font_size=FONT_PX)
        x = offset + picture.width - GAP_PX
        for name, colour in (("socket", SOCKET_COLOUR), ("plug", PLUG_COLOUR)):
            length = draw.textlength(name, font_size=FONT_PX)
            fill = tuple(round(255 * part) for part in colour[:3])
            draw.text((x - length, 6), name, fill=fill, font_size=FONT_PX)
            x -= int(length) + 2 * GAP_PX
    return joined.resize((width, round(joined.height * width / joined.width)), Image.Resampling.LANCZOS)


@run_cli
def main() -> None:
    """Console entry point."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--config_path", type=Path, required=True, help="of the environment")
    parser.add_argument("--before", required=True, help="checkpoint on the left")
    parser.add_argument("--after", required=True, help="checkpoint on the right")
    parser.add_argument(
        "--titles",
        nargs=2,
        default=["after imitation", "after DPPO"],
        help="above the pictures (default: %(default)s)",
    )
    parser.add_argument("--output", type=Path, required=True, help="GIF to write")
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the first episode")
    parser.add_argument("--episodes", type=at_least(1), default=3, help="default %(default)s")
    parser.add_argument("--width", type=at_least(1), default=900, help="of the picture, in pixels")
    flags = parser.parse_args()
    check_file("--output", flags.output)
    env = draccus.decode(VtRefineEnvConfig, _env(flags.config_path))
    seeds = range(flags.seed, flags.seed + flags.episodes)
    left, right = (list(filmed(policy, env, seeds)) for policy in (flags.before, flags.after))
    episodes = []
    for before, after in zip(left, right, strict=True):
        steps = zip_longest(before, after)
        last, pairs = (before[0], after[0]), []
        for pair in steps:
            last = (pair[0] or last[0], pair[1] or last[1])  # who is done waits for the other
            pairs.append(side_by_side(*last, tuple(flags.titles), flags.width))
        episodes.append(pairs)
    write_gif(episodes, FRAME_MS, flags.output)
    print(f"{flags.output}: {flags.output.stat().st_size / 1e3:.0f} kB")


def _env(path: Path) -> dict:
    settings = read_yaml(path).get("env", {})
    return {key: value for key, value in settings.items() if key != "type"}


if __name__ == "__main__":
    raise SystemExit(main())
