"""Keep readers from files that another file names: those beside an image, and those of a scene.toml."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.cube_sources import reading
from spectralzoom.storage.readers.user_files import first_there, is_there

_OF_TIFF = (".ovr", ".msk")  # endings of files beside an image, which GDAL opens by their content


def stated_file(folder: Path, name: str, where: str) -> Path:
    """Return a file that a scene.toml in ``folder`` names, relative to it (SceneError: the name is absolute)."""
    if Path(name).is_absolute():
        raise SceneError(f"{where} = {name!r} is an absolute path; write it relative to {folder}, or name it as a flag")
    is_there(folder / name)
    return folder / name


def check_sidecars(image: Path, driver: str) -> None:
    """Check the files beside an image that GDAL opens with it; other neighbours may be anything.

    Raises SceneError: one is no file or a link that leads nowhere; or an overview or mask is no TIFF or names a file.
    """
    rasterio = importlib.import_module("rasterio")
    with os.scandir(image.parent) as entries:
        plain = {image.with_name(one.name): one.is_file(follow_symlinks=False) for one in entries}
    strange = any(not is_plain and not (path.is_file() or path.is_dir()) for path, is_plain in plain.items())
    for path in plain:
        name = path.name.casefold()
        own = name.startswith(f"{image.name.casefold()}.") or Path(name).stem == image.stem.casefold()
        if own and path != image and name.endswith(_OF_TIFF) and first_there([path]):
            _check_wanted(path, "GTiff", strange)
            with reading(path, "TIFF", "move it elsewhere"), rasterio.open(path, driver="GTiff") as file:
                check_overviews(file, path)
    _check_wanted(image, driver, strange)


def _check_wanted(image: Path, driver: str, strange: bool) -> None:
    """Refuse what GDAL opens with an image and is no file (SceneError); only ``strange`` folders have such."""
    for path in _opened_with(image, driver) if strange else ():
        is_there(path)


def _opened_with(image: Path, driver: str) -> set[Path]:
    """Return the files that GDAL opens with an image: it opens them through Python, where what is no file is absent."""
    rasterio, containers = (importlib.import_module(name) for name in ("rasterio", "rasterio.abc"))
    wanted: set[Path] = set()

    def opened(path: str, *_mode: str, **_options: Any) -> BinaryIO:
        wanted.add(Path(path))
        if not Path(path).is_file():
            raise FileNotFoundError(path)
        return Path(path).open("rb")

    methods: dict[str, Callable[..., Any]] = {
        "isdir": lambda path: Path(path).is_dir(),
        "isfile": lambda path: not Path(path).is_dir() and (Path(path).exists() or Path(path).is_symlink()),
        "ls": lambda path: [one.name for one in Path(path).iterdir()],
        "mtime": lambda path: int(Path(path).stat().st_mtime),
        "size": lambda path: Path(path).stat().st_size,
        "rm": lambda path: None,
        "open": opened,
    }
    folder = type("Folder", (containers.FileContainer,), {name: staticmethod(one) for name, one in methods.items()})()
    # an error is raised again where the image is read
    with suppress(Exception), rasterio.open(image.absolute(), driver=driver, opener=folder) as file:
        check_overviews(file, image)
        assert file.files
        file.read_masks(1, window=((0, 1), (0, 1)))
    return wanted


def check_overviews(file: Any, path: Path) -> None:
    """Refuse an open rasterio file whose tags name another file or a server as its overviews (SceneError).

    GDAL would open it, by any of its drivers, as soon as masks are read.
    """
    if named := file.tags(ns="OVERVIEWS"):
        raise SceneError(
            f"{path} says that its overviews are in {', '.join(named.values())}, which is not opened; write it again "
            "without them (rio convert)"
        )
