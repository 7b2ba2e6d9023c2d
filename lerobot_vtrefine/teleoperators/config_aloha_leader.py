"""Configuration of ALOHA's two leader arms."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("aloha_leader")
@dataclass(kw_only=True)
class AlohaLeaderConfig(TeleoperatorConfig):
    """Two WidowX-250s arms, moved by hand.

    Attributes:
        left_port: Serial port of the left arm, best by a stable path such as /dev/serial/by-id/...
        right_port: Serial port of the right arm.
    """

    left_port: str
    right_port: str
