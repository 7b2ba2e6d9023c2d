"""The one list of what this package changes in LeRobot 0.6.1 or depends on beyond its interfaces, and why.

Each seam is one module of this package, is opened only by what needs it, and asks `guard` for the version.
`tests/lerobot_compat/test_seams.py` holds a probe for each: it fails once LeRobot does by itself what the
seam is for, which then can go.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Seam:
    """One place where this package reaches into LeRobot."""

    module: str
    """Module of this package, below `lerobot_compat`."""
    changes: tuple[str, ...]
    """What of LeRobot it replaces or extends, as dotted paths; empty where it only hooks in."""
    why: str
    """What LeRobot 0.6.1 does without it."""
    opened_by: str
    on_other_versions: str
    """What happens with a LeRobot that `guard` does not know."""


SEAMS = (
    Seam(
        "arrays",
        (
            "lerobot.utils.feature_utils.hw_to_dataset_features",
            "lerobot.utils.feature_utils.build_dataset_frame",
        ),
        "recording takes scalars and images only: a robot's arrays, such as pads, are refused",
        "robots with pads, when they are made",
        "refuses to record",
    ),
    Seam(
        "arrow_keys",
        ("lerobot.utils.keyboard_input._PYNPUT_KEY_NAMES",),
        "the arrow keys by which keyboard_ee moves a hand also end an episode or start it anew",
        "vtrefine_ee with keyboard_ee, while it is connected",
        "warns and leaves the arrows to LeRobot",
    ),
    Seam(
        "card",
        ("lerobot.datasets.lerobot_dataset.LeRobotDataset.push_to_hub",),
        "a dataset's card says nothing of what its columns hold",
        "robots with pads, when they are made",
        "warns and leaves the card alone",
    ),
    Seam(
        "checkpoint_guard",
        (
            "lerobot.processor.pipeline.DataProcessorPipeline._validate_loaded_config",
            "lerobot.policies.factory.make_pre_post_processors",
        ),
        "a checkpoint's processor file may name any Python callable, which is imported and called",
        "the policy package, when it is imported; configurations of vt_dp3, when they are made",
        "stays: it only refuses",
    ),
    Seam(
        "config_errors",
        ("lerobot.configs.parser.DecodingError", "draccus.parsers.decoding.decode_dataclass"),
        "the parser replaces a configuration's own reason by \"Couldn't instantiate class\", and prints"
        " several lines about a value that it cannot decode",
        "configurations and commands of this package",
        "stays: it only raises other exceptions",
    ),
    Seam(
        "decoder_notice",
        (),
        "where FFmpeg is missing, every dataset that is opened logs ninety lines of tracebacks",
        "importing this package",
        "stays: it only shortens that message",
    ),
    Seam(
        "fast_reader",
        ("lerobot.datasets.lerobot_dataset.DatasetReader", "lerobot.datasets.lerobot_dataset.LeRobotDataset"),
        "array columns are decoded through Python lists, 45 ms an item, and never a batch at once",
        "LeRobot's commands, when they discover plugins; configurations of vt_dp3, when they are made",
        "warns and reads the slow way",
    ),
    Seam(
        "fast_saving",
        (
            "lerobot.datasets.dataset_writer.compute_episode_stats",
            "lerobot.datasets.dataset_writer.embed_images",
        ),
        "statistics make a 5000-bin histogram per taxel, images are embedded one by one",
        "vtrefine-record-demos, while it saves",
        "replaces only the functions that it knows",
    ),
    Seam(
        "lazy_workers",
        (),
        "asynchronous environments whose workers wait for the first reset have no public name",
        "--env.vectorization=gym and what else makes vector environments",
        "stays: it only imports",
    ),
    Seam(
        "live_view",
        (
            "lerobot.utils.visualization_utils.log_rerun_data",
            "lerobot.utils.visualization_utils.log_foxglove_data",
        ),
        "--display_data draws a pad as one curve per taxel",
        "robots with pads, when they are made",
        "warns and shows curves",
    ),
    Seam(
        "phases",
        (
            "lerobot.scripts.lerobot_record.record_loop",
            "lerobot.scripts.lerobot_teleoperate.teleop_loop",
            "lerobot.rollout.strategies.base.BaseStrategy.run",
            "lerobot.rollout.strategies.episodic.EpisodicStrategy._policy_loop",
            "lerobot.rollout.strategies.episodic.EpisodicStrategy._reset_loop",
            "lerobot.scripts.lerobot_replay.LeRobotDataset",
        ),
        "a robot is not told where an episode begins or ends, so a simulated one could not start anew, nor at"
        " which rate it is driven",
        "simulated robots and vtrefine_ee, when they are made",
        "refuses to make them",
    ),
    Seam(
        "policy_server",
        ("lerobot.async_inference.constants.SUPPORTED_POLICIES",),
        "its policy server refuses policies that are not in its list, and hands them no arrays",
        "vtrefine-policy-server",
        "refuses to start",
    ),
    Seam(
        "registration",
        (),
        "plugins are found by the prefix of their distribution's name only",
        "LeRobot's commands, when they discover plugins",
        "stays: it only imports",
    ),
    Seam(
        "safe_recording",
        (
            "lerobot.datasets.lerobot_dataset.LeRobotDataset.create",
            "lerobot.datasets.lerobot_dataset.LeRobotDataset.resume",
            "lerobot.datasets.lerobot_dataset.LeRobotDatasetMetadata",
            "lerobot.datasets.lerobot_dataset.DatasetWriter",
            "lerobot.datasets.dataset_metadata.write_info",
            "lerobot.datasets.dataset_metadata.write_stats",
            "lerobot.datasets.dataset_metadata.write_tasks",
            "lerobot.datasets.dataset_writer.write_info",
            "lerobot.datasets.dataset_writer.write_image",
            "lerobot.datasets.image_writer.write_image",
        ),
        "Parquet files stay open for the session: what stops it takes every episode with it",
        "robots with pads, when they are made",
        "warns and records LeRobot's way",
    ),
    Seam(
        "action_rates",
        (
            "lerobot.scripts.lerobot_train.make_train_eval_datasets",
            "lerobot.scripts.lerobot_rollout.build_rollout_context",
            "lerobot.async_inference.robot_client.RobotClient.start",
        ),
        "lerobot-train evaluates at any --env.fps; lerobot-rollout and the client of asynchronous inference"
        " move arms at any --fps, whatever the dataset's",
        "LeRobot's commands, when they discover plugins",
        "leaves the check out",
    ),
)
