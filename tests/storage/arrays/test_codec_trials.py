"""Codecs on trial: what goes in comes out, and sizes are those of what is kept."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import SettingsError
from storage.arrays.layout import CODECS, store_in_memory

LINES = np.random.default_rng(0).poisson(300, (40, 70, 9)).astype(np.uint16)


@pytest.mark.parametrize("codec", CODECS)
def test_numbers_come_back(codec: str) -> None:
    """No codec changes a number."""
    _, back = store_in_memory(LINES, codec)
    np.testing.assert_array_equal(back, LINES)


def test_without_a_codec_size_is_that_of_the_chunks() -> None:
    """Whole chunks of 32 x 32 px, and little more for shard indices and checksums."""
    size, _ = store_in_memory(LINES, "none")
    chunks = 64 * 96 * 9 * 2
    assert chunks <= size < 1.01 * chunks


def test_bit_planes_compress_better_than_bytes_in_order() -> None:
    """The default codec holds counts with noise in fewer bytes than plain zstd."""
    assert store_in_memory(LINES, "zstd-3")[0] < store_in_memory(LINES, "zstd-3 bytes in order")[0] < LINES.nbytes


def test_an_unknown_codec_is_refused() -> None:
    """The message names those there are."""
    with pytest.raises(SettingsError, match="one of none, lz4-5"):
        store_in_memory(LINES, "brotli")
