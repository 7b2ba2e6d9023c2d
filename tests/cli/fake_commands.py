"""Stand-ins for the demo's commands: they write the files of the real ones in no time."""

import json
import sys
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

PADS = ("left_arm_left_finger", "left_arm_right_finger", "right_arm_left_finger", "right_arm_right_finger")


def record(options: dict[str, str]) -> None:
    root = Path(options["root"])
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text("{}")
    folder = root / "data" / "chunk-000"
    folder.mkdir(parents=True)
    columns = {f"observation.tactile_baseline.{pad}": [[4] * 384] * 2 for pad in PADS}
    pressed = [[[4] * 384, [4] * 100 + [4 + 50 * index] + [4] * 283] for index in range(4)]
    columns |= {f"observation.tactile.{pad}": pressed[index] for index, pad in enumerate(PADS)}
    pq.write_table(pa.table(columns), folder / "file-000.parquet")


def write_checkpoint(options: dict[str, str]) -> None:
    folder = Path(options["output_dir"]) / "checkpoints" / "last" / "pretrained_model"
    folder.mkdir(parents=True)
    (folder / "model.safetensors").write_bytes(b"")


def information(options: dict[str, str]) -> None:
    folder = Path(options["output_dir"])
    folder.mkdir(parents=True)
    (folder / "information.json").write_text("{}")


def clone_on_features(options: dict[str, str]) -> None:
    folder = Path(options["output_dir"]) / "pretrained_model"
    folder.mkdir(parents=True)
    (folder / "model.safetensors").write_bytes(b"")


def finetune(options: dict[str, str]) -> None:
    write_checkpoint(options)
    lines = ["iteration,success", *(f"{index},{0.1 * index}" for index in range(5))]
    (Path(options["output_dir"]) / "progress.csv").write_text("\n".join(lines))


def write_video(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for shade in range(0, 250, 25):
            image = np.full((48, 64, 3), shade, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def evaluate(options: dict[str, str]) -> None:
    """Fine-tuned policies succeed in 3 of 4 episodes, others in 1 of 4."""
    output = Path(options["output_dir"])
    output.mkdir(parents=True)
    episodes, seed = int(options["eval.n_episodes"]), int(options["seed"])
    wins = 3 if "finetune" in options["policy.path"] else 1
    successes = [index % 4 < wins for index in range(episodes)]
    videos = [
        output / "videos" / f"eval_episode_{index}.mp4"
        for index in range(min(int(options["env.video_episodes"]), episodes))
    ]
    for video in videos:
        write_video(video)
    metrics = {"successes": successes, "video_paths": [str(video) for video in videos]}
    info = {"per_task": [{"metrics": metrics}], "overall": {"eval_s": 1.5}}
    (output / "eval_info.json").write_text(json.dumps(info))
    rows = [
        {
            "seed": seed + index,
            "steps": 24,
            "success": success,
            "failure": None if success else "dropped",
            "picked_up": success,
            "in_hand_shift_m": 0.001,
            "rim_slide_m": 0.01,
            "peak_force_n": 8.0,
            "time_to_success_s": 2.0 if success else None,
        }
        for index, success in enumerate(successes)
    ]
    Path(options["env.metrics_path"]).write_text("".join(json.dumps(row) + "\n" for row in rows))


def record_starts(options: dict[str, str]) -> None:
    Path(options["path"]).parent.mkdir(parents=True)
    Path(options["path"]).write_bytes(b"")


COMMANDS = {
    "vtrefine-record-demos": record,
    "lerobot-train": write_checkpoint,
    "vtrefine-information": information,
    "python": clone_on_features,
    "lerobot-eval": evaluate,
    "vtrefine-record-starts": record_starts,
    "vtrefine-finetune": finetune,
}


if __name__ == "__main__":
    pairs = (argument.removeprefix("--").split("=", 1) for argument in sys.argv[2:] if "=" in argument)
    COMMANDS[sys.argv[1]](dict(pairs))
