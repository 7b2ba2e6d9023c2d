"""The iteration beside a busy process: measured for real, at tiny size, and OpenMP's threads do not spin."""

import os
import subprocess
import sys

import pytest

from lerobot_vtrefine.finetune import benchmark_busy


def test_a_row_with_the_ratio_and_the_cores_given_back():
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    [(name, ratio, explanation)] = benchmark_busy.run(num_envs=2, rounds=1)
    assert "nice 19" in name
    assert ratio > 0
    assert "2 environments on 2 cores" in explanation
    assert not cores or os.sched_getaffinity(0) == cores


@pytest.mark.parametrize(
    ("chosen", "spins"),
    [({}, "1000"), ({"OMP_WAIT_POLICY": "PASSIVE"}, "0")],
)
def test_commands_tell_openmp_before_it_is_loaded(chosen, spins):
    """What GNU OpenMP says that it uses, in a process that imports what every command imports first."""
    named = {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY", "OMP_NUM_THREADS"}
    plain = {key: value for key, value in os.environ.items() if key not in named}
    code = "import lerobot_vtrefine.cli, sys; assert 'torch' not in sys.modules; import torch"
    shown = subprocess.run(
        [sys.executable, "-c", code],
        env=plain | chosen | {"OMP_DISPLAY_ENV": "verbose"},
        capture_output=True,
        text=True,
        check=True,
    ).stderr
    if "GOMP_SPINCOUNT" not in shown:
        pytest.skip("PyTorch has another OpenMP here")
    assert f"GOMP_SPINCOUNT = '{spins}'" in shown
