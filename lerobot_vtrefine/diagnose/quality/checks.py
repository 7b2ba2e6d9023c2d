"""All checks in their order."""

from lerobot_vtrefine.diagnose.quality import (
    drive,
    frames,
    joints,
    outliers,
    readings,
    response,
    session,
    sizes,
    units,
    wiring,
)
from lerobot_vtrefine.diagnose.quality.edits import Check, apply
from lerobot_vtrefine.diagnose.quality.rules import MIN_PART, MIN_TRIALS
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.verdict import DataIssue
from lerobot_vtrefine.wording import plural

# Each check gets what the ones before it left: first frames and times, then readings. Frames without numbers
# are dropped after the clock was checked, which would take them for lost ones; all other checks need numbers.
UNIT_CHECKS: tuple[Check, ...] = (sizes.check_sizes, units.check_units)
"""Also applied before a prediction; none of these uses readings."""
FRAME_CHECKS: tuple[Check, ...] = (
    frames.check_repeats,
    frames.check_spikes,
    *UNIT_CHECKS,
    frames.check_clock,
    units.check_temperature,
    frames.check_optional,
    frames.check_numbers,
    frames.check_length,
    session.check_session,
)
PAD_CHECKS: tuple[Check, ...] = (
    drive.check_drives,
    readings.check_readings,
    drive.check_signs,
    drive.check_forces,
    drive.check_contact,
    response.check_stuck,
    readings.check_wraps,
    wiring.check_wiring,
    response.check_start,
    response.check_answers,
    outliers.check_odd,
    outliers.check_gain,
    session.check_conditions,
)
PLACED_CHECKS: tuple[Check, ...] = (response.check_answers, outliers.check_odd, outliers.check_gain)
"""With miswired rows or columns, these would reject every trial."""
ROBOT_CHECKS: tuple[Check, ...] = (
    joints.check_jumps,
    joints.check_commands,
    joints.check_encoders,
    joints.check_steps,
    joints.check_joint_order,
    session.check_conditions,
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
        miswired |= check is wiring.check_wiring and any(issue.trial is None for issue in found)
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
    """Why too little of a set passed quality control for a verdict; None if enough did."""
    left, total = len(checked.trials), len(recorded.trials)
    if left < MIN_TRIALS:
        return DataIssue(
            None, f"{plural(left, 'sound trial')} of {total}; at least {MIN_TRIALS} are needed", "no verdict"
        )
    if left < MIN_PART * total:
        return DataIssue(None, f"only {left} of {total} trials are sound", "no verdict")
    return None
