"""Codecs of Zarr stores: the usual ones give the stored numbers, others are refused by name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import zarr
from zarr.storage import LocalStore

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.allowed_codecs import PACKERS, CheckedStore
from spectralzoom.storage.readers.open_cubes import open_cube_source

CUBE = np.arange(4 * 6 * 5, dtype=np.uint16).reshape(4, 6, 5)


@pytest.mark.filterwarnings("ignore:Numcodecs codecs are not in the Zarr version 3")
@pytest.mark.parametrize("packer", PACKERS)
@pytest.mark.parametrize("version", [2, 3])
def test_ordinary_chunks_are_read(tmp_path: Path, packer: str, version: int) -> None:
    """Every packer that is allowed gives the numbers that were stored."""
    packing: Any = numcodecs.get_codec({"id": packer}) if version == 2 else {"name": packer, "configuration": {}}
    if version == 3 and packer in ("zlib", "bz2", "lz4"):
        packing = {"name": f"numcodecs.{packer}", "configuration": {}}
    zarr.create_array(tmp_path / "a.zarr", data=CUBE, zarr_format=version, compressors=packing)  # type: ignore[arg-type]
    np.testing.assert_array_equal(open_cube_source(tmp_path / "a.zarr").read(0, 4), CUBE)


@pytest.mark.parametrize("packer", ["pickle", "lzma", "zfpy", "pcodec", "packbits", "vlen-utf8"])
def test_other_codecs_are_refused(tmp_path: Path, packer: str) -> None:
    """The message names the codec and the packers that are read, however deep the array lies."""
    array = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2).create_array("b/c/cube", data=CUBE)
    path = tmp_path / "a.zarr" / array.path / ".zarray"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"compressor": {"id": packer}}))
    group = zarr.open_group(CheckedStore(LocalStore(tmp_path / "a.zarr", read_only=True)), mode="r")
    with pytest.raises(
        SceneError, match=rf"cube/\.zarray asks for the codec '{packer}', which is not read; .*blosc, zst"
    ):
        group["b/c/cube"]
