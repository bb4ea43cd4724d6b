"""A quick part of the run over mutated files of every format; the whole is ``python tests/faults/mutated_files.py``."""

from __future__ import annotations

import pytest

from tests.faults.mutated_files import FORMATS, try_files

pytest.importorskip("tifffile")


@pytest.mark.filterwarnings("ignore::Warning")  # decoders may warn of what they then refuse
def test_mutated_files_end_well() -> None:
    """Each file gives a cube or one clear error, soon, in memory bounded by its size."""
    found = try_files(18 * len(FORMATS), seed=7)
    assert [line for tally in found.values() for line in tally.wrong] == []
    assert min(tally.read + tally.refused for tally in found.values()) == 18
    assert sum(tally.refused for tally in found.values()) > 40
    assert sum(tally.read for tally in found.values()) > 40
