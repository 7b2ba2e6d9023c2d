"""Kinds of files and flags that commands take from outside: a sound one each, its mutants, its command."""

import kinds_of_datasets
import kinds_of_devices
import kinds_of_realities
import kinds_of_recordings
import kinds_of_results

KINDS = (
    *kinds_of_recordings.KINDS,
    *kinds_of_realities.KINDS,
    *kinds_of_devices.KINDS,
    *kinds_of_datasets.KINDS,
    *kinds_of_results.KINDS,
)
