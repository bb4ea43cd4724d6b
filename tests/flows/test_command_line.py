"""The command line's own process: what it settles before anything is computed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ONE_THREAD = """
import os, sys
from flows.cli import main
assert "numpy" not in sys.modules, "numpy has read its number of threads already"
try:
    main(["--version"])
except SystemExit:
    print(os.environ["OPENBLAS_NUM_THREADS"])
"""


def test_numpy_computes_on_one_thread_whatever_the_shell_says() -> None:
    """Sums split among threads round otherwise: one seed would give other light on a machine with more cores."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "OPENBLAS_NUM_THREADS": "2"}
    command = [sys.executable, "-c", ONE_THREAD]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout.split()[-1]) == (0, "1"), ended.stderr
