"""Lets LeRobot read datasets with pads from memory.

LeRobot 0.6.1 decodes every column of every item from Arrow through Python lists: with eight pad columns and
depth at two observation steps that costs about 45 ms per item, many times a training step of a small policy.

Scope: only datasets with the pad columns of ``features.py``; every other dataset, and every case that is not
covered (videos too large for memory, depth as video, language columns, another LeRobot version), takes
LeRobot's own path. ``install`` is called when the package is registered, so that LeRobot's own policies learn
from the colour images of such data as fast, and when a ``vt_dp3`` configuration is made.
"""

import logging
import sys
from typing import Any

from lerobot_vtrefine.lerobot_compat.guard import is_supported

logger = logging.getLogger(__name__)

DATASET_MODULE = "lerobot.datasets.lerobot_dataset"


def install() -> None:
    """Serve covered datasets from memory in this process; does nothing if no dataset code is loaded yet.

    Idempotent. On a LeRobot version that was not tested it logs a warning and leaves LeRobot as it is.
    """
    module: Any = sys.modules.get(DATASET_MODULE)
    if module is None:
        return
    if not is_supported():
        logger.warning("This LeRobot version is untested: dataset items are read the slow way.")
        return
    from lerobot_vtrefine.lerobot_compat.frame_reader import FastDatasetReader, serve_batches

    module.DatasetReader = FastDatasetReader
    serve_batches()
