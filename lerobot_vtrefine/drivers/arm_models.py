"""Which motors Interbotix's arms have: ids, models, and the joints that two motors share."""

from dataclasses import dataclass

from lerobot.motors import Motor, MotorNormMode

GRIPPER = "gripper"


@dataclass(frozen=True)
class ArmModel:
    """Motors of one arm.

    Attributes:
        motors: (name, id, model) of the driven motors, base to gripper.
        shadows: (name, id, model, followed motor) of motors that share a joint with another one.
    """

    motors: tuple[tuple[str, int, str], ...]
    shadows: tuple[tuple[str, int, str, str], ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Motors but the gripper."""
        return tuple(name for name, _, _ in self.motors if name != GRIPPER)

    def bus_motors(self) -> dict[str, Motor]:
        """All motors as LeRobot's bus wants them."""
        everything = [*self.motors, *((name, number, model) for name, number, model, _ in self.shadows)]
        return {name: Motor(number, model, MotorNormMode.DEGREES) for name, number, model in everything}


VIPERX_300S = ArmModel(
    motors=(
        ("waist", 1, "xm540-w270"),
        ("shoulder", 2, "xm540-w270"),
        ("elbow", 4, "xm540-w270"),
        ("forearm_roll", 6, "xm540-w270"),
        ("wrist_angle", 7, "xm540-w270"),
        ("wrist_rotate", 8, "xm430-w350"),
        (GRIPPER, 9, "xm430-w350"),
    ),
    shadows=(("shoulder_shadow", 3, "xm540-w270", "shoulder"), ("elbow_shadow", 5, "xm540-w270", "elbow")),
)
"""ALOHA's follower (motor map of LeRobot's former viperx robot)."""

WIDOWX_250S = ArmModel(
    motors=(
        ("waist", 1, "xm430-w350"),
        ("shoulder", 2, "xm430-w350"),
        ("elbow", 4, "xm430-w350"),
        ("forearm_roll", 6, "xm430-w350"),
        ("wrist_angle", 7, "xm430-w350"),
        ("wrist_rotate", 8, "xl430-w250"),
        (GRIPPER, 9, "xc430-w150"),
    ),
    shadows=(("shoulder_shadow", 3, "xm430-w350", "shoulder"), ("elbow_shadow", 5, "xm430-w350", "elbow")),
)
"""ALOHA's leader (motor map of LeRobot's former widowx teleoperator)."""
