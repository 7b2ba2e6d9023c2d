"""Every kernel compiles for a GPU: NVIDIA's compiler comes with Warp and needs none."""

import importlib
from pathlib import Path

import pytest

wp = pytest.importorskip("warp")
import lerobot_vtrefine  # noqa: E402
from lerobot_vtrefine.sim.backends.warp_newton_kernels import newton_kernel  # noqa: E402
from lerobot_vtrefine.sim.backends.warp_solve import THREADS  # noqa: E402
from lerobot_vtrefine.tactile.kernels_lanes import BLOCK  # noqa: E402

PACKAGE = Path(lerobot_vtrefine.__file__).parent
AMPERE = 80
"""Compute capability of an A100."""
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if "\n@wp.kernel" in path.read_text()
)
TOUCH = [name for name in MODULES if ".tactile." in name]
WARPS_OWN = 256
"""Threads of a block where a launch does not say."""
VELOCITIES = 28
"""Eight of each arm, six of each part."""


@pytest.fixture(scope="module", autouse=True)
def compiler():
    wp.init()
    if AMPERE not in wp._src.context.runtime.nvrtc_supported_archs:
        pytest.skip("Warp here has no compiler for GPUs")


def check(module, threads, folder, monkeypatch):
    """Compile machine code for blocks of so many threads; the assembler refuses more shared memory than a
    block can have.
    """
    monkeypatch.setitem(module.options, "block_dim", threads)
    (path,) = wp.compile_aot_module(module, arch=AMPERE, module_dir=folder, use_ptx=False)
    assert path.read_bytes()[:4] == b"\x7fELF"


@pytest.mark.parametrize("name", MODULES)
def test_a_module_compiles(name, tmp_path, monkeypatch):
    importlib.import_module(name)
    check(wp.get_module(name), BLOCK if name in TOUCH else WARPS_OWN, tmp_path, monkeypatch)


def test_the_solver_compiles(tmp_path, monkeypatch):
    check(newton_kernel(VELOCITIES).module, THREADS, tmp_path, monkeypatch)
