"""Refuse codecs of Zarr stores that may run code, and name what an HDF5 file keeps in other files."""

from __future__ import annotations

import json
import re
from typing import Any

import h5py
from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import WrapperStore

from spectralzoom.pipeline.errors import SceneError

PACKERS = ("blosc", "zstd", "gzip", "zlib", "bz2", "lz4")
PLAIN_CODECS = {
    *("crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3"),  # checksums
    *("bytes", "transpose", "sharding_indexed", "shuffle"),  # orders
    *("delta", "fixedscaleoffset", "quantize", "bitround", "astype", "cast_value", "scale_offset"),  # of numbers
}


class CheckedStore(WrapperStore[Store]):
    """A store of any kind whose arrays use codecs of numbers alone.

    Raises SceneError on others, such as pickle. Consolidated metadata are left out: each array's own are read.
    """

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key; metadata are checked first."""
        name = key.rpartition("/")[2]
        found = None if name == ".zmetadata" else await super().get(key, prototype, byte_range)
        if found is None or name not in ("zarr.json", ".zarray"):
            return found
        about = json.loads(found.to_bytes())
        where = f"{str(self).partition('://')[2]}/{key}"
        if not isinstance(about, dict):
            raise SceneError(f"{where} holds no table; copy the store again")
        about.pop("consolidated_metadata", None)
        for listed in ("compressor", "filters", "codecs"):
            _check_codecs(about.get(listed) or [], where)
        _check_fill(about, where)
        return prototype.buffer.from_bytes(json.dumps(about).encode())


def _check_fill(about: dict[str, Any], where: str) -> None:
    """Refuse the metadata of an array of numbers whose fill value is none (SceneError)."""
    kind, fill = str(about.get("dtype", about.get("data_type"))), about.get("fill_value", 0)
    special = "nan|inf(inity)?" if "dtype" in about else r"nan|inf(inity)?|0x[\da-f]+"
    forms = r"[\d.]+(e[-+]?\d+)?|" + (special if "f" in kind else r"\d+")
    is_number = re.fullmatch(f"[-+]?({forms})", str(fill).lower())
    of_numbers = re.fullmatch(r"[<>|=]?[biuf]\d+|bool|u?int\d+|float\d+", kind)
    if of_numbers and not (is_number or isinstance(fill, bool) or (fill is None and "dtype" in about)):
        raise SceneError(f"{where} has fill_value = {str(fill)[:80]!r}, expected a number; correct it")


def _check_codecs(codecs: Any, where: str) -> None:
    """Refuse codecs of metadata, also those within shards (SceneError: one is not allowed)."""
    for one in codecs if isinstance(codecs, list) else [codecs]:
        given = one if isinstance(one, dict) else {"name": one}
        name = str(given.get("name", given.get("id")))
        kind = name.lower().removeprefix("numcodecs.")
        if kind not in PLAIN_CODECS.union(PACKERS):
            raise SceneError(
                f"{where} asks for the codec {name!r}, which is not read; store plain numbers with {', '.join(PACKERS)}"
            )
        inner = given.get("configuration")
        if kind == "sharding_indexed" and isinstance(inner, dict):
            _check_codecs([*inner.get("codecs", ()), *inner.get("index_codecs", ())], where)


def outside_links(file: h5py.File) -> list[str]:
    """Return a sentence for each link, external array and virtual array of a file, which may lead to any other file."""
    found: list[str] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.ExternalLink):
            found.append(f"{name} is a link to {item.filename}:{item.path}")
        elif isinstance(item, h5py.Dataset) and (item.external or item.is_virtual):
            others = [one[0] for one in item.external or ()] or [one.file_name for one in item.virtual_sources()]
            found.append(f"{name} takes its numbers from {', '.join(others[:1]) or 'no file'}")

    file.visititems_links(visit)
    file.visititems(visit)
    return found
