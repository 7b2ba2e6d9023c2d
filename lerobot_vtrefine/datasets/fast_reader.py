"""Array columns of LeRobot datasets from memory."""


def install() -> None:
    """Placeholder until the reader lands."""
