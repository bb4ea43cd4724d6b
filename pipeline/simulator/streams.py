"""Random streams of the simulator: one for each use by its own key, so that no draw depends on what else is drawn."""

from __future__ import annotations

import zlib

import numpy as np


def line_stream(seed: int, sweep: str, effect: str, number: int) -> np.random.Generator:
    """Give the stream of one effect at one line of one sweep: blocks, order and other effects never change it."""
    return _stream(seed, _word(sweep), _word(effect), number)


def sweep_stream(seed: int, sweep: str, effect: str) -> np.random.Generator:
    """Give the stream of one effect for a whole sweep."""
    return _stream(seed, _word(sweep), _word(effect))


def unit_stream(unit: int, effect: str) -> np.random.Generator:
    """Give the stream of what belongs to one copy of the rig, whatever it looks at: its fixed patterns."""
    return _stream(unit, _word(effect))


def _word(name: str) -> int:
    return zlib.crc32(name.encode())


def _stream(entropy: int, *key: int) -> np.random.Generator:
    """Give a stream whose key is hashed to its state; words of SFC64 take half the time of a counter-based Philox."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(entropy=entropy, spawn_key=key)))
