"""When a task can show that touch pays: the rule, stated once for terminal, page, file and tables."""

from dataclasses import dataclass

TRUE_AT_LEAST, TOUCH_AT_LEAST, VISION_AT_MOST = 0.95, 0.90, 0.70
"""Success of the expert that acts on the truth, on touch and vision, and on vision alone."""


@dataclass(frozen=True)
class Verdict:
    """Whether a task needs touch."""

    accepted: bool | None
    """None: not judged."""
    short: str
    """In two or three words, for tables."""
    reason: str
    """In a sentence."""


def judge(truth: float | None, both: float | None, vision: float | None) -> Verdict:
    """The verdict on shares of episodes in which the expert succeeded; None: not measured."""
    if truth is None or both is None or vision is None:
        needed = "it needs the expert's success on the truth, on both senses and on vision"
        return Verdict(None, "not judged", f"Not judged: {needed}.")
    if truth < TRUE_AT_LEAST:
        reason = f"the expert fails where it knows everything ({truth:.2f} succeed)"
        return Verdict(False, "too hard for the expert", f"Not a touch task: {reason}.")
    if both < TOUCH_AT_LEAST:
        reason = f"touch and vision together do not suffice ({both:.2f} succeed)"
        return Verdict(False, "touch does not suffice", f"Not a touch task: {reason}.")
    if vision > VISION_AT_MOST:
        return Verdict(
            False, "vision suffices", f"Not a touch task: vision alone suffices ({vision:.2f} succeed)."
        )
    reason = f"{both:.2f} succeed with touch and vision, {vision:.2f} with vision alone"
    return Verdict(True, "needs touch", f"A touch task: {reason}.")
