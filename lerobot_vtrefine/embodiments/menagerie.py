"""Where MuJoCo Menagerie has an arm's meshes. Only pictures need them; the user downloads them."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_vtrefine.embodiments.shapes import Shape

FLAG = "--env.menagerie_dir"
"""What gives Menagerie's folder."""
REPOSITORY = "https://github.com/google-deepmind/mujoco_menagerie"


@dataclass(frozen=True)
class MenagerieArm:
    """The same arm in MuJoCo Menagerie, whose meshes can stand for an embodiment's shapes in pictures."""

    model: str
    """Its file within Menagerie."""
    joints: tuple[str, ...]
    """Its names of one arm's revolute joints, from the base on; equal angles are equal postures."""
    shows_palm: bool
    """Whether its last link's meshes show what `fingers.palm` stands for."""
    carriages: tuple[Shape, ...] = ()
    """What joins the left finger to those meshes, in the finger's frame; the right finger's are mirrored."""


def menagerie_file(arm: MenagerieArm | None, body: str, menagerie_dir: Path) -> Path:
    """The model of a body's arm.

    Raises:
        ValueError: Menagerie has none.
        FileNotFoundError: it is not in the folder.
    """
    if arm is None:
        raise ValueError(
            f"{FLAG}: MuJoCo Menagerie is not known to have the arm of {body}; leave the flag out"
        )
    path = Path(menagerie_dir).expanduser() / arm.model
    if not path.is_file():
        raise FileNotFoundError(f"{FLAG}: there is no {path}: get it by git clone {REPOSITORY}")
    return path
