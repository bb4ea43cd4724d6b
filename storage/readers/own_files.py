"""Keep readers within the folder of the file that was named.

Files that a reader finds by itself may have come with the data: a link among them could lead to any file.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.cube_sources import reading

# endings of metadata that GDAL finds by other names than the image's (Landsat, Pleiades, SPOT, ALOS, RapidEye)
_METADATA = (".txt", ".xml", ".imd", ".rpb", ".rpc", ".pvl", ".dim", ".eph", ".pass")
_OF_TIFF = (".ovr", ".msk")  # endings of files beside an image, which GDAL opens by their content


def within(named: Path, found: Path, also: Path | None = None) -> Path:
    """Return a file or folder that a reader found by the ``named`` file or folder.

    A named link may lead anywhere, and what is found may lie where it leads. ``also`` is a folder that belongs to it.
    Raises SceneError: ``found`` is a link out of these folders.
    """
    folders = [named.resolve()] if named.is_dir() else [named.parent.resolve(), named.resolve().parent]
    folders += [] if also is None else [also.resolve()]
    target = found.resolve()
    if not any(target.is_relative_to(folder) for folder in folders):
        raise SceneError(
            f"{found} is a link out of its folder, to {target}, and is not followed; copy the file there, or name it "
            "yourself"
        )
    return found


def stated_file(folder: Path, name: str, where: str) -> Path:
    """Return a file that a scene.toml in ``folder`` names, relative to it.

    Raises SceneError: the name is absolute, or leads to a link out of the stated folder.
    """
    if Path(name).is_absolute():
        raise SceneError(f"{where} = {name!r} is an absolute path; write it relative to {folder}, or name it as a flag")
    path = folder / name
    home = Path(os.path.normpath(folder.resolve() / name)).parent
    if not path.resolve().is_relative_to(home):
        raise SceneError(f"{where}: {path} is a link to {path.resolve()}, and is not followed; copy the file there")
    return path


def check_sidecars(image: Path) -> None:
    """Check the files beside an image that GDAL may open: metadata, and those whose names begin as its own.

    Raises SceneError: one is a link out of the folder or no file; or an overview or mask is no TIFF or names a file.
    """
    rasterio = importlib.import_module("rasterio")
    stem = image.stem.casefold()
    with os.scandir(image.parent) as entries:
        names = [one.name for one in entries]
    beside = [image.parent / one for one in names if one.casefold().startswith(stem) or one.lower().endswith(_METADATA)]
    for path in beside:
        if path == image or within(image, path).is_dir():
            continue
        if not path.is_file():  # reading a pipe may never end
            raise SceneError(f"{path} is no file; move it elsewhere")
        if path.suffix.lower() in _OF_TIFF:
            with reading(path, "TIFF", "move it elsewhere"), rasterio.open(path, driver="GTiff") as file:
                check_overviews(file, path)


def check_overviews(file: Any, path: Path) -> None:
    """Refuse an open rasterio file whose tags name another file or a server as its overviews (SceneError).

    GDAL would open it, by any of its drivers, as soon as masks are read.
    """
    if named := file.tags(ns="OVERVIEWS"):
        raise SceneError(
            f"{path} says that its overviews are in {', '.join(named.values())}, which is not opened; write it again "
            "without them (rio convert)"
        )
