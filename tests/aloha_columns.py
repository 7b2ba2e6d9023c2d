"""Names in data of ALOHA, on which most tests run."""

from lerobot_vtrefine.datasets.features import baseline_keys, raw_keys, tactile_keys
from lerobot_vtrefine.embodiments import ALOHA

PADS = ALOHA.pad_names
TACTILE_KEYS, BASELINE_KEYS, RAW_KEYS = tactile_keys(ALOHA), baseline_keys(ALOHA), raw_keys(ALOHA)
