"""A value that is made when it is first asked for."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import pytest

from pipeline.lazy import Once


def test_a_value_is_made_once_whoever_asks() -> None:
    """Threads that ask at the same time get the same value, of one making."""
    make, together = Mock(side_effect=object), threading.Barrier(8)
    once = Once(make)

    def ask(_: int) -> object:
        together.wait()
        return once()

    assert not once.is_made()
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(ask, range(8)))
    assert once.is_made()
    assert make.call_count == len(set(found)) == 1


def test_what_fails_is_asked_for_again() -> None:
    """An error reaches who asked, and the next one tries anew; nothing is a value too."""
    once: Once[None] = Once(Mock(side_effect=[ValueError("not yet"), None]))
    with pytest.raises(ValueError, match="not yet"):
        once()
    assert not once.is_made()
    once()
    assert once.is_made()
    assert Once.of(None).is_made()
