"""All checks in their order."""

from lerobot_vtrefine.diagnose.quality.drive import (
    check_contact,
    check_drives,
    check_forces,
    check_signs,
)
from lerobot_vtrefine.diagnose.quality.edits import Check, apply
from lerobot_vtrefine.diagnose.quality.frames import (
    check_clock,
    check_length,
    check_numbers,
    check_optional,
    check_repeats,
    check_spikes,
)
from lerobot_vtrefine.diagnose.quality.joints import (
    check_commands,
    check_encoders,
    check_joint_order,
    check_jumps,
)
from lerobot_vtrefine.diagnose.quality.outliers import check_gain, check_odd
from lerobot_vtrefine.diagnose.quality.readings import check_readings, check_wraps
from lerobot_vtrefine.diagnose.quality.response import check_answers, check_start, check_stuck
from lerobot_vtrefine.diagnose.quality.session import check_conditions, check_session
from lerobot_vtrefine.diagnose.quality.sizes import check_sizes
from lerobot_vtrefine.diagnose.quality.units import check_temperature, check_units
from lerobot_vtrefine.diagnose.quality.wiring import check_wiring
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.verdict import DataIssue

MIN_TRIALS = 4
"""Fewer leave none for choosing beside those that are held out."""
MIN_PART = 1 / 3
"""If less than this part of a set is sound, the rest is not trusted either."""

# Each check sees what the ones before it left: first frames and times, then what the pad says. Frames without
# numbers are dropped after the clock was checked, which would take them for lost ones; all other checks need
# numbers.
UNIT_CHECKS: tuple[Check, ...] = (check_sizes, check_units)
"""What a prediction has to mend as well; none of these looks at readings."""
FRAME_CHECKS: tuple[Check, ...] = (
    check_repeats,
    check_spikes,
    *UNIT_CHECKS,
    check_clock,
    check_temperature,
    check_optional,
    check_numbers,
    check_length,
    check_session,
)
PAD_CHECKS: tuple[Check, ...] = (
    check_drives,
    check_readings,
    check_signs,
    check_forces,
    check_contact,
    check_stuck,
    check_wraps,
    check_wiring,
    check_start,
    check_answers,
    check_odd,
    check_gain,
    check_conditions,
)
PLACED_CHECKS: tuple[Check, ...] = (check_answers, check_odd, check_gain)
"""With lines in the wrong place, these would find every trial at fault."""
ROBOT_CHECKS: tuple[Check, ...] = (
    check_jumps,
    check_commands,
    check_encoders,
    check_joint_order,
    check_conditions,
)


def check_quality(recordings: RecordingSet) -> tuple[RecordingSet, list[DataIssue]]:
    """Set aside or repair what is broken.

    Returns:
        The set without the trials set aside and with the repaired ones, and an entry for everything found.
        Ask `too_little` whether what is left can be judged.
    """
    issues: list[DataIssue] = []
    miswired = False
    for check in FRAME_CHECKS + (PAD_CHECKS if recordings.kind == "pad" else ROBOT_CHECKS):
        if not recordings.trials or (check in PLACED_CHECKS and miswired):
            continue
        recordings, found = apply(recordings, list(check(recordings)))
        miswired |= check is check_wiring and any(issue.trial is None for issue in found)
        issues += found
    return recordings, issues


def in_si_units(recordings: RecordingSet) -> tuple[RecordingSet, list[DataIssue]]:
    """The set with lengths, angles and times in the format's units where they clearly were in others.

    Trials in units that nobody knows are kept as they are.
    """
    issues: list[DataIssue] = []
    for check in UNIT_CHECKS:
        repairs = [finding for finding in check(recordings) if finding.trial is not None or finding.setting]
        recordings, found = apply(recordings, repairs)
        issues += found
    return recordings, issues


def too_little(checked: RecordingSet, recorded: RecordingSet) -> DataIssue | None:
    """Why what quality control left of a set does not suffice for a verdict; None if it does."""
    left, total = len(checked.trials), len(recorded.trials)
    if left < MIN_TRIALS:
        return DataIssue(
            None, f"{left} sound trials of {total}; at least {MIN_TRIALS} are needed", "no verdict"
        )
    if left < MIN_PART * total:
        return DataIssue(None, f"only {left} of {total} trials are sound", "no verdict")
    return None
