"""One recording at a time in a dataset's folder: two would give their episodes the same numbers and files. So
for whatever else goes on in a folder.
"""

import os
from pathlib import Path
from weakref import WeakSet

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None


class Claim:
    """Keeps other recordings out of a folder until it is closed, or the process ends in whatever way."""

    def __init__(self, root: Path, kind: str = "recording", flag: str = "--dataset.root") -> None:
        """Raise ValueError where another of this kind goes on in the folder, which ``flag`` names."""
        self._descriptor: int | None = None
        if fcntl is None:
            return
        self._descriptor = os.open(root, os.O_RDONLY)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            raise ValueError(
                f"another {kind} goes on in {root}: end it first, or choose another {flag}"
            ) from None
        except OSError:  # some file systems have no locks
            self.close()
        _claims.add(self)

    def close(self) -> None:
        """Let others in."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)


_claims: WeakSet[Claim] = WeakSet()


def _leave_to_parent() -> None:
    """Processes that write images may live on when the recording was killed."""
    for claim in list(_claims):
        claim.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)
