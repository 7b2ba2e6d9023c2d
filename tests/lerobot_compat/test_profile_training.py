"""``scripts/profile_training.py`` reads LeRobot's log: its format must be the one that LeRobot writes."""

import profile_training as script
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker


def test_times_are_found_in_lerobots_own_line():
    names = {"update_s": "updt_s", "dataloading_s": "data_s"}
    meters = {name: AverageMeter(title, ":.3f") for name, title in names.items()}
    meters["samples_per_s"] = AverageMeter("smp/s", ":.0f")
    tracker = MetricsTracker(128, 1000, 20, meters)
    tracker.update_s, tracker.dataloading_s, tracker.samples_per_s = 0.005, 0.002, 19200
    assert script.TIMES.findall(str(tracker)) == [("0.005", "0.002", "19200")]
