"""A value that is computed at its first use."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import pytest

from spectralzoom.pipeline.once import Once


def test_threads_share_one_computation() -> None:
    """Eight threads that request a value at the same time get the same one, computed once."""
    make = Mock(side_effect=object)
    together = threading.Barrier(8)
    once = Once(make)

    def ask(_: int) -> object:
        together.wait()
        return once()

    assert not once.is_made()
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(ask, range(8)))
    assert once.is_made()
    assert make.call_count == len(set(found)) == 1


def test_a_failed_computation_is_retried() -> None:
    """The error reaches the caller, and the next call computes again. None is a valid value."""
    once: Once[None] = Once(Mock(side_effect=[ValueError("not yet"), None]))
    with pytest.raises(ValueError, match="not yet"):
        once()
    assert not once.is_made()
    once()
    assert once.is_made()
    assert Once.of(None).is_made()
