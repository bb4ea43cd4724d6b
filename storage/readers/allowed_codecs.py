"""Refuse codecs of Zarr stores that may run code, and limit those that unpack; find links and filters of HDF5 files."""

from __future__ import annotations

import json
import math
import re
from collections.abc import AsyncIterator
from typing import Any

import h5py
import numpy as np
from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore, WrapperStore

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.chunk_limits import LIMITED, PACKERS
from spectralzoom.storage.readers.user_files import files_below, is_there

CHECKSUMS = ("crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3")  # of four bytes
PLAIN_CODECS = {
    *("bytes", "transpose", "sharding_indexed", "shuffle"),  # orders
    *("delta", "fixedscaleoffset", "quantize", "bitround", "astype", "cast_value", "scale_offset"),  # of numbers
}
_TYPES = ("dtype", "decode_dtype", "astype", "encode_dtype")  # in codecs; the last one is that of the stored numbers
ORDERING = (2, 3, 5, 6)  # filters of HDF5 that do not unpack: shuffle, fletcher32, nbit, scaleoffset


class CheckedStore(WrapperStore[LocalStore]):
    """A store in a folder, whose arrays use codecs of numbers alone, and whose chunks give what their array declares.

    Links in it are followed. Raises SceneError on other codecs, such as pickle, and on what is no file. Consolidated
    metadata are left out: each array's own are read.
    """

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key; metadata are checked first, and name a limited codec for each packer."""
        name = key.rpartition("/")[2]
        is_there(self._store.root / key)
        found = None if name == ".zmetadata" else await super().get(key, prototype, byte_range)
        if found is None or name not in ("zarr.json", ".zarray"):
            return found
        about = json.loads(found.to_bytes())
        where = f"{str(self).partition('://')[2]}/{key}"
        if not isinstance(about, dict):
            raise SceneError(f"{where} holds no table; copy the store again")
        about.pop("consolidated_metadata", None)
        if "codecs" in about:
            about["codecs"] = _checked(about["codecs"], where)
        elif name == ".zarray":
            codecs = [*(about.get("filters") or []), *([packer] if (packer := about.get("compressor")) else [])]
            number = np.dtype(about["dtype"]) if isinstance(about["dtype"], str) else np.dtype("V")
            codecs = _checked(codecs, where, math.prod(about["chunks"]), number.itemsize)
            about |= (
                {"filters": codecs[:-1] or None, "compressor": codecs[-1]} if packer else {"filters": codecs or None}
            )
        _check_fill(about, where)
        return prototype.buffer.from_bytes(json.dumps(about).encode())

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Yield the keys that begin with a folder; those in linked folders too."""
        for file in files_below(self._store.root / prefix):
            yield file.relative_to(self._store.root).as_posix()


def _check_fill(about: dict[str, Any], where: str) -> None:
    """Refuse the metadata of an array of numbers whose fill value is none (SceneError)."""
    kind, fill = str(about.get("dtype", about.get("data_type"))), about.get("fill_value", 0)
    special = "nan|inf(inity)?" if "dtype" in about else r"nan|inf(inity)?|0x[\da-f]+"
    forms = r"[\d.]+(e[-+]?\d+)?|" + (special if "f" in kind else r"\d+")
    is_number = re.fullmatch(f"[-+]?({forms})", str(fill).lower())
    of_numbers = re.fullmatch(r"[<>|=]?[biuf]\d+|bool|u?int\d+|float\d+", kind)
    if of_numbers and not (is_number or isinstance(fill, bool) or (fill is None and "dtype" in about)):
        raise SceneError(f"{where} has fill_value = {str(fill)[:80]!r}, expected a number; correct it")


def _checked(codecs: Any, where: str, numbers: int | None = None, width: int = 0) -> list[Any]:
    """Return codecs of metadata with the packer replaced, also those within shards; in the order of writing.

    Of Zarr v2 a chunk has so many ``numbers`` of ``width`` bytes. Raises SceneError: a codec is not allowed.
    """
    found: list[Any] = []
    kinds: list[str] = []
    for codec in codecs:
        given = codec if isinstance(codec, dict) else {"name": codec}
        name = str(given.get("name", given.get("id")))
        about = given.get("configuration") or given
        types = [np.dtype(about[key]) for key in _TYPES if about.get(key) is not None]
        kinds.append(name.lower().removeprefix("numcodecs."))
        if kinds[-1] not in PLAIN_CODECS.union(PACKERS, CHECKSUMS) or any(one.kind not in "buif" for one in types):
            raise SceneError(
                f"{where} asks for the codec {name!r}, which is not read; store plain numbers with {', '.join(PACKERS)}"
            )
        width = types[-1].itemsize if types else width
        if kinds[-1] == "sharding_indexed":
            lists = {key: _checked(about[key], where) for key in ("codecs", "index_codecs") if key in about}
            codec = given | {"configuration": about | lists}
        elif kinds[-1] in PACKERS:
            if {"sharding_indexed", *PACKERS} & {*kinds[:-1]}:
                raise SceneError(f"{where} packs chunks twice, by {kinds[-2]} and {name}; store them with one packer")
            spare = 4 * sum(one in CHECKSUMS for one in kinds)
            codec = {"name": LIMITED, "configuration": {"packer": kinds[-1], "spare": spare}}
            if numbers is not None:
                codec = {"id": LIMITED, "packer": kinds[-1], "size": numbers * width + spare}
        found.append(codec)
    return found


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


def check_filters(dataset: h5py.Dataset) -> None:
    """Refuse an HDF5 array that is packed twice: 1 kB of it could become gigabytes (SceneError)."""
    plist = dataset.id.get_create_plist()
    codes = [plist.get_filter(number)[0] for number in range(plist.get_nfilters())]
    if sum(code not in ORDERING for code in codes) > 1:
        where = f"{dataset.file.filename}:{dataset.name}"
        raise SceneError(f"{where} is packed twice, by the HDF5 filters {codes}; repack it (h5repack -f GZIP=4)")
