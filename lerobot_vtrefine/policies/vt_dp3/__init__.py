"""The ``vt_dp3`` policy type; importing this registers its configuration and processor step with LeRobot, and
guards what checkpoints may load.
"""

from lerobot_vtrefine.lerobot_compat import checkpoint_guard
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import (
    VisuoTactileProcessorStep,
    make_vt_dp3_pre_post_processors,
)

__all__ = ["VisuoTactileProcessorStep", "VtDp3Config", "make_vt_dp3_pre_post_processors"]

checkpoint_guard.install()
