"""What was wrong with recordings, for the terminal."""

from collections.abc import Sequence

from lerobot_vtrefine.diagnose.verdict import DataIssue
from lerobot_vtrefine.wording import plural

SHOWN = 4
"""Lines; the others are in the report."""


def issue_lines(issues: Sequence[DataIssue]) -> list[str]:
    """What was set aside, repaired or kept, and where."""
    lines = [
        f"{issue.trial or 'all recordings'}: {issue.problem} ({issue.action})" for issue in issues[:SHOWN]
    ]
    more = len(issues) - SHOWN
    return lines + ([f"{plural(more, 'more problem')} of the data in the report"] if more > 0 else [])
