"""The codec of old raw sweeps: pcodec, lossless and smaller than blosc, but no codec of the Zarr specification.

It stands in the place of ``bytes, blosc``; the crc32c after it, chunks and shards stay as they are.
"""

from __future__ import annotations

import re
import warnings
from typing import Any

from numcodecs.errors import UnknownCodecError  # type: ignore[import-untyped]
from zarr.errors import ZarrUserWarning

from pipeline.errors import IncompleteStoreError

MissingCodecError: type[ValueError] = UnknownCodecError  # what numcodecs raises for a codec that it does not have
PCODEC_NAME = "numcodecs.pcodec"  # as zarr.json has it
PCODEC_LEVEL = 8  # of 12: more costs time and saves nothing, see ``tradeoff store``

# zarr warns whenever it meets a codec of numcodecs that other Zarr programs may not read. Whoever runs pack is told
# that by its manual, and later readers can do nothing about it: this one sentence is kept from them, nothing else is.
_NOT_IN_SPECIFICATION = (
    "ignore", re.compile("Numcodecs codecs are not in the Zarr version 3 specification", re.I), ZarrUserWarning, None, 0
)  # fmt: skip


def allow_pcodec() -> None:
    """Keep zarr's warning of codecs beyond its specification from users; may be called any number of times."""
    if _NOT_IN_SPECIFICATION not in warnings.filters:
        _, words, kind, _, _ = _NOT_IN_SPECIFICATION
        warnings.filterwarnings("ignore", message=words.pattern, category=kind)


def pcodec(level: int = PCODEC_LEVEL) -> Any:
    """The codec, to be given to zarr as the ``serializer`` of an array of 16, 32 or 64 bits."""
    from zarr.codecs.numcodecs import PCodec

    allow_pcodec()
    return PCodec(level=level)


def missing_codec(where: str, error: ValueError) -> IncompleteStoreError:
    """What to say of an array whose codec this Python does not have; its bytes may well be whole."""
    name = str(getattr(error, "codec_id", error)).strip("'")
    return IncompleteStoreError(
        f"{where} is packed with {name}, which is not installed; pip install {name} (nothing is damaged)"
    )
