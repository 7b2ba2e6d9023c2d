"""A robot is one file in `embodiments/`: nobody else names a body, its joints, pads or type."""

import ast
from pathlib import Path

import lerobot_vtrefine
from lerobot_vtrefine.embodiments import ALOHA, DEFAULT_BODY, KINOVA
from lerobot_vtrefine.observation.visuo_tactile import VisuoTactileConfig
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.teleoperators.config_vtrefine_ee import VtRefineEeConfig

PACKAGE = Path(lerobot_vtrefine.__file__).parent
BODIES = (ALOHA, KINOVA)
ITS_OWN_HARDWARE = (
    "drivers/aloha_emulator.py",
    "drivers/arm_models.py",
    "robots/aloha_tactile_follower.py",
    "robots/config_aloha_tactile_follower.py",
    "teleoperators/aloha_leader.py",
    "teleoperators/config_aloha_leader.py",
)
ITS_OWN_DATA = ("datasets/importers/aloha_npz.py", "cli/import_dataset.py")
WHAT_SHIPS_FOR_IT = ("cli/pipeline/demo_config.py", "cli/results/cells.py")
"""The encoder of each body, and what tables call it."""


WORDS = {
    word
    for body in BODIES
    for word in (
        body.name,
        body.robot_type,
        *body.joint_names,
        *body.pad_names,
        *(joint.name for joint in body.joints),
    )
}


def names_a_body(path: Path) -> bool:
    text = path.read_text(encoding="utf-8")
    if not any(word.lower() in text.lower() for word in WORDS):
        return False
    tree = ast.parse(text)
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and {"ALOHA", "KINOVA"} & {alias.name for alias in node.names}:
            return True
        if isinstance(node, ast.Constant) and id(node) not in prose and node.value in WORDS:
            return True
    return False


def test_only_embodiments_know_bodies() -> None:
    allowed = {*ITS_OWN_HARDWARE, *ITS_OWN_DATA, *WHAT_SHIPS_FOR_IT}
    naming = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if "embodiments" not in path.parts and names_a_body(path)
    }
    assert naming <= allowed
    assert "drivers/arm_models.py" in naming  # the search finds what is there


def test_the_default_is_named_once() -> None:
    defaults = (SceneConfig().embodiment, VisuoTactileConfig().embodiment, VtRefineEeConfig().embodiment)
    assert set(defaults) == {DEFAULT_BODY}
