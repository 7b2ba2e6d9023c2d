"""Each seam is still needed: its probe shows what LeRobot does without it, and fails once LeRobot does it."""

import ast
import inspect
import pkgutil
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import compute_stats, io_utils
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import create_lerobot_dataset_card
from lerobot.envs import utils as env_utils
from lerobot.processor.pipeline import DataProcessorPipeline
from lerobot.utils import feature_utils, import_utils, keyboard_input, visualization_utils

from lerobot_vtrefine import lerobot_compat
from lerobot_vtrefine.lerobot_compat import arrays, card, checkpoint_guard, live_view, phases, safe_recording
from lerobot_vtrefine.lerobot_compat.seams import SEAMS

PROBES: dict[str, Callable[..., None]] = {}


def probe(function: Callable[..., None]) -> Callable[..., None]:
    PROBES[function.__name__] = function
    return function


@pytest.fixture(autouse=True)
def stock() -> None:
    """LeRobot as it is, whatever earlier tests opened."""
    for seam in (arrays, card, live_view, phases, safe_recording):
        seam.uninstall()


@probe
def arrays_(_: Path) -> None:
    with pytest.raises(ValueError, match="3-tuple"):
        feature_utils.hw_to_dataset_features({"tactile.left": (384,)}, "observation")


@probe
def arrow_keys_(_: Path) -> None:
    source = inspect.getsource(keyboard_input)
    assert 'key in ("right", "n")' in source
    assert 'key in ("left", "r")' in source


@probe
def card_(_: Path) -> None:
    text = str(create_lerobot_dataset_card(tags=["a"], repo_id="me/set"))
    assert "[More Information Needed]" in text.split("## Dataset Structure")[0]


@probe
def checkpoint_guard_(_: Path) -> None:
    steps = [{"class": "subprocess.Popen", "config": {"args": ["true"]}}]
    checkpoint_guard._validate(DataProcessorPipeline, "me/policy", {"name": "x", "steps": steps}, "file.json")


@dataclass
class Refusing:
    size: int = 0

    def __post_init__(self) -> None:
        if self.size:
            raise ValueError("sizes are out of fashion")


@probe
def config_errors_(_: Path) -> None:
    with pytest.raises(draccus.utils.DraccusException) as caught:
        draccus.decode(Refusing, {"size": 1})
    assert "fashion" not in str(caught.value)


@probe
def decoder_notice_(_: Path) -> None:
    source = inspect.getsource(import_utils.get_safe_default_video_backend)
    assert 'f"{e}\\n' in source  # the whole chain of tracebacks is part of the message


@probe
def fast_reader_(folder: Path) -> None:
    dataset = small_dataset(folder)
    dataset.finalize()
    read = LeRobotDataset("local/small", root=folder / "small")
    assert read.hf_dataset.format["type"] == "custom"  # a function over Python lists


@probe
def fast_saving_(_: Path) -> None:
    stats = compute_stats.RunningQuantileStats()
    stats.update(np.zeros((4, 7)))
    assert len(stats._histograms) == 7
    assert "batched=False" in inspect.getsource(io_utils.embed_images)


@probe
def lazy_workers_(_: Path) -> None:
    public = {name.lower() for name in vars(env_utils) if not name.startswith("_")}
    assert not [name for name in public if "async" in name]


@probe
def live_view_(_: Path) -> None:
    rerun = pytest.importorskip("rerun")
    logged: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rerun, "log", lambda path, entity, **_: logged.append(type(entity).__name__))
        patch.setattr(rerun, "send_blueprint", lambda *_, **__: None)
        visualization_utils.log_rerun_data(observation={"observation.tactile.left": np.zeros(384, np.uint8)})
    assert logged == ["Scalars"]  # a curve for each of its values


@probe
def phases_(_: Path) -> None:
    from lerobot.scripts import lerobot_record

    asked = set(re.findall(r"\brobot\.(\w+)\(", inspect.getsource(lerobot_record)))
    asked -= {"connect", "disconnect"}  # once a session, not once an episode
    assert asked == {"get_observation", "send_action", "_from_keyboard_to_base_action"}


@probe
def policy_server_(_: Path) -> None:
    pytest.importorskip("grpc")
    folder = Path(import_utils.__file__).parents[1] / "async_inference"
    assert "policy_type not in SUPPORTED_POLICIES" in (folder / "policy_server.py").read_text()
    assert "return {**state_dict, **image_dict}" in (folder / "helpers.py").read_text()  # and nothing else


@probe
def registration_(_: Path) -> None:
    source = inspect.getsource(import_utils.register_third_party_plugins)
    assert "lerobot_policy_" in source
    assert "entry_points" not in source


@probe
def safe_recording_(folder: Path) -> None:
    dataset = small_dataset(folder)
    (path,) = (folder / "small" / "data").rglob("*.parquet")
    with pytest.raises(pa.ArrowInvalid):
        pq.read_table(path)
    dataset.finalize()


@probe
def action_rates_(_: Path) -> None:
    from lerobot.rollout import context
    from lerobot.scripts import lerobot_rollout, lerobot_train

    assert "fps" not in inspect.getsource(lerobot_train)
    assert "build_rollout_context(cfg" in inspect.getsource(lerobot_rollout)
    assert not re.search(r"polic\S*fps", inspect.getsource(context))
    client = (Path(import_utils.__file__).parents[1] / "async_inference" / "robot_client.py").read_text()
    assert "self.stub.SendPolicyInstructions(policy_setup)" in client  # which holds no rate:
    policy = client.partition("self.policy_config = RemotePolicyConfig(")[2].partition("self.channel")[0]
    assert "config.policy_type" in policy
    assert "fps" not in policy


def small_dataset(folder: Path) -> LeRobotDataset:
    """One saved episode of a session that has not ended."""
    features = {"observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]}}
    dataset = LeRobotDataset.create("local/small", 10, features, root=folder / "small", use_videos=False)
    for _ in range(3):
        dataset.add_frame({"observation.state": np.zeros(2, np.float32), "task": "none"})
    dataset.save_episode()
    return dataset


@pytest.mark.parametrize("seam", SEAMS, ids=lambda seam: seam.module)
def test_lerobot_still_needs_it(seam: object, tmp_path: Path) -> None:
    PROBES[f"{seam.module}_"](tmp_path)


@pytest.mark.parametrize("seam", SEAMS, ids=lambda seam: seam.module)
def test_what_it_changes_is_there(seam: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # LeRobot's asynchronous inference makes a folder logs/ where it is imported
    for path in seam.changes:
        if "async_inference" in path:
            pytest.importorskip("grpc")
        owner, name = path.rsplit(".", 1)
        assert hasattr(pkgutil.resolve_name(owner), name), path


MUTATING = ("append", "add", "clear", "extend", "insert", "pop", "remove", "setdefault", "update")


def root_of(node: ast.AST) -> str:
    """The name that a chain of attributes and items begins with."""
    while isinstance(node, ast.Attribute | ast.Subscript):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def reaches_into_lerobot(path: Path) -> bool:
    """Whether a module defines ``install``, changes what it imports from LeRobot, or imports what is
    private there."""
    imported: set[str] = set()
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "lerobot":
            imported |= {alias.asname or alias.name for alias in node.names}
            if any(alias.name.startswith("_") for alias in node.names):
                return True
    for node in nodes:
        if isinstance(node, ast.FunctionDef) and node.name == "install":
            return True
        targets = node.targets if isinstance(node, ast.Assign) else []
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in MUTATING:
            targets = [node.func]
        if isinstance(node, ast.Call) and root_of(node.func) == "setattr":
            targets = [ast.Attribute(node.args[0], "")]
        if any(isinstance(t, ast.Attribute | ast.Subscript) and root_of(t) in imported for t in targets):
            return True
    return False


def test_every_module_that_reaches_into_lerobot_is_listed() -> None:
    folder = Path(lerobot_compat.__file__).parent
    reaching = {path for path in folder.parent.rglob("*.py") if reaches_into_lerobot(path)}
    listed = {folder / f"{seam.module}.py" for seam in SEAMS} | {folder / "benchmark.py"}  # measures a seam
    assert reaching - listed == set()
    assert len(reaching) > 10
