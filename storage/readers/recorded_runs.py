"""Raw cubes of archives: those of a run, of one capture, or single ones, by the address that stands for them."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import ArchiveError, IncompleteStoreError, SceneError
from storage.archive.archive import Archive
from storage.archive.records import Run, read_run, read_store
from storage.arrays.layout import open_group
from storage.remote.object_stores import is_remote
from storage.remote.opening import is_archive, open_archive

RAW_PRODUCTS = ("raw_coarse", "raw_fine", "raw_again")  # of a run


def find_raw_cubes(address: str | Path) -> list[Path] | None:
    """Find the raw cubes that an address stands for, in the order of their names; None where it is no such address.

    Raises ArchiveError: the archive has no run of that name, or no run with raw cubes; as `Archive.locate` where they
    are gone.
    """
    named = _named_run(address)
    if named is not None:
        return _run_with_cubes(*named)[2]
    path = Path(address)
    if not path.exists():
        raise SceneError(f"there is no recording {path}; check the name (seen from {Path.cwd()})")
    if not path.is_dir():
        return None
    if _is_raw_cube(path):
        return [path]
    return sorted(one for one in path.glob("*.zarr") if _is_raw_cube(one)) or None


def _is_raw_cube(path: Path) -> bool:
    """Whether a folder is a store that a survey wrote its lines into; other stores are judged by who reads them."""
    if not (path / "zarr.json").is_file():
        return False
    try:
        return "sweep" in open_group(path).attrs
    except IncompleteStoreError:
        return False


def find_recorded_run(address: str | Path) -> tuple[Run, tuple[int, int] | None] | None:
    """Find the run of an archive whose raw cubes an address stands for, with its field's (y, x) size where known.

    None of addresses that stand for no run. Raises SceneError, ArchiveError: as `find_raw_cubes`.
    """
    named = _named_run(address)
    if named is None:
        if not Path(address).exists():
            raise SceneError(f"there is no recording {address}; check the name (seen from {Path.cwd()})")
        return None
    archive, run, _ = _run_with_cubes(*named)
    for row in run.stages:
        if row.get("name") == "score":
            grid = read_store(archive.ref("score", str(row.get("key")))).params.get("grid", {})
            if {"height", "width"} <= set(grid):
                return run, (int(grid["height"]), int(grid["width"]))
    return run, None


def _named_run(address: str | Path) -> tuple[str, str | None] | None:
    """The archive and the run, where one is named, that an address stands for; None where it is no such address."""
    text = str(address).rstrip("/")
    place, _, run = text.rpartition("/runs/")
    if place and run and is_archive(place):
        return place, run
    return (text, None) if is_remote(text) or (Path(text) / "stages").is_dir() else None


def _run_with_cubes(address: str, name: str | None) -> tuple[Archive, Run, list[Path]]:
    """A run of an archive with its raw cubes, the newest that has some where none is named."""
    archive = open_archive(address, create=False, write=False)
    folders = archive.runs()
    if name is not None and name not in [folder.name for folder in folders]:
        known = ", ".join(folder.name for folder in folders[-5:]) or "none"
        raise ArchiveError(f"{archive.name} has no run {name!r}; its latest are {known}")
    for folder in reversed(folders):
        if name in (None, folder.name):
            run = read_run(folder, {})
            stores = [archive.locate(run.products[product]) for product in RAW_PRODUCTS if product in run.products]
            cubes = [path for store in stores for path in sorted(store.glob("*.zarr"))]
            if cubes:
                return archive, run, cubes
    which = "no run" if name is None else f"the run {name}"
    raise ArchiveError(f"{archive.name}: {which} has raw cubes; survey into the archive first, or name another run")
