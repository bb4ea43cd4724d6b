"""Hold large arrays of simulated scenes in files, so that memory does not grow with the scene."""

from __future__ import annotations

import os
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 2**28  # of an array in memory; larger ones are in a file


def scratch(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return an array of zeros; a large one is in a file without a name, which the system reads and writes by pages.

    Raises OSError: the disk is full. The folder is that of TMPDIR, by default /var/tmp, since /tmp may be memory.
    """
    if 4 * np.prod(shape) <= MOST_BYTES:
        return np.zeros(shape, np.float32)
    with TemporaryFile(dir=os.environ.get("TMPDIR", "/var/tmp")) as file:
        if hasattr(os, "posix_fallocate"):  # not on macOS; a full disk would end the process later
            os.posix_fallocate(file.fileno(), 0, 4 * int(np.prod(shape)))
        return np.asarray(np.memmap(file, np.float32, "r+", shape=shape))
