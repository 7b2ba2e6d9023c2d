"""The benchmark of the third rig: which sets it makes."""

import sys
from argparse import Namespace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
import bench_jittered


def test_every_set_has_a_specimen_of_its_own() -> None:
    args = Namespace(
        laws=",".join([bench_jittered.CLEAN, *bench_jittered.jittered_rig.EFFECTS]),
        gains=[0.2, 0.4],
        seeds=(5, 7),
        pad=(12, 32),
    )
    sets = bench_jittered.chosen(args).values()
    assert len({bench_jittered.specimen(law, gain, seed) for law, gain, seed, *_ in sets}) == len(sets)
