"""Store a file or folder as one immutable cube of an archive: the verb `ingest`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.settings.flags import ArchiveName, AsJson, parse_numbers
from flows.terminal.processes import DONE
from flows.terminal.progress import StageProgress, print_json, show_text, stderr
from pipeline.errors import SceneError
from pipeline.ground.georeference import georeference_record
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.staging import check_name, file_hash
from storage.readers.cube_sources import CubeSource
from storage.readers.open_cubes import open_cube, reader_of, with_wavelengths
from storage.readers.recorded_files import find_pointing
from storage.readers.scene_files import with_stated_values
from storage.readers.zarr_files import Report, SourceFile, write_ingested_cube
from storage.remote.opening import open_archive

STAGE = "ingest"
VERSION = 2
TITLES = {"read": "reading the files", STAGE: "storing the cube"}


def ingest(
    source: str,
    archive: ArchiveName,
    *,
    name: str | None = None,
    dark: str | None = None,
    white: str | None = None,
    wavelengths: str | None = None,
    as_json: AsJson = False,
) -> int:
    """Store SOURCE in ARCHIVE as one cube that never changes; the same content is stored once.

    Parameters
    ----------
    source
        ENVI header or data file, folder of a Headwall camera, GeoTIFF, .mat, .npy, .npz, PNG, JPEG, BMP, or Zarr store.
    name
        Name of the cube; the file's or folder's name by default.
    dark
        Dark frame, ENVI or .npy, averaged over its lines; a Headwall folder's own by default.
    white
        White frame, likewise.
    wavelengths
        Centre wavelengths of all bands [nm], if the files lack them: 660,800
    """
    nm = parse_numbers(wavelengths, "--wavelengths")
    record = run_ingest(source, archive, stderr, name=name, dark=dark, white=white, wavelengths=nm)
    show_text(f"next: {_next(record, source, wavelengths)}")
    if as_json:
        print_json(record)
    return DONE


def run_ingest(
    source: str,
    archive: str | Path,
    console: Console,
    *,
    name: str | None = None,
    dark: str | None = None,
    white: str | None = None,
    wavelengths: Sequence[float] | None = None,
) -> dict[str, Any]:
    """Store a source in an archive, with progress on ``console``; return the record that --json prints.

    The key of the store is a hash of the files' content and the flags, so the same content is stored once. Raises
    SceneError, WavelengthError: the source cannot be used, or changed while it was read; ArchiveError: the name is not
    allowed, or the archive cannot be written to.
    """
    if name is not None:
        check_name(name)
    with console.status("opening the source"):
        found = with_wavelengths(open_cube(source, dark=dark, white=white), source, wavelengths)
        cube = with_stated_values(found, source)
        opened = open_archive(archive)
        opened.reclaim()  # of a killed ingest
    with opened.in_use(), StageProgress(console, TITLES) as progress:
        before = _stamps(cube)
        files = hash_files(cube, lambda done: progress.show("read", done))
        progress.show("read", 1.0, ended=True)

        def build(path: Path) -> None:
            write_ingested_cube(
                path, cube, files, name=name or cube.name, report=lambda done: progress.show(STAGE, done)
            )
            if _stamps(cube) != before:
                raise SceneError(f"{source} changed while it was read; ingest it again once it is whole")

        ref, built = opened.produce(STAGE, build, version=VERSION, params=_key(name, cube, files))
        progress.show(STAGE, 1.0, "" if built else "cached", ended=True)
    record = _record(opened, ref, cube, files, cached=not built)
    _print(record, cube, console)
    return record


def hash_files(source: CubeSource, report: Report) -> list[SourceFile]:
    """Return the name, size and SHA-256 of every file of a cube; names are relative to a store."""
    files: list[SourceFile] = []
    for number, path in enumerate(source.files):
        root = source.root
        name = path.relative_to(root).as_posix() if root is not None and path.is_relative_to(root) else path.name
        files.append(SourceFile(name, path.stat().st_size, file_hash(path)))
        report((number + 1) / len(source.files))
    return files


def _next(record: Mapping[str, Any], source: str, wavelengths: str | None) -> str:
    """Return the command that surveys the cube: a camera's numbers as a recording, images and maps as a scene."""
    words = ["spectralzoom", "survey"]
    image = record["georeferenced"] or reader_of(source) in ("image", "array")
    if not image and record["source_dtype"].lstrip("<>=|") in ("u1", "u2", "i2"):
        path = Path(source)
        table = find_pointing(path.parent, path.name.removesuffix(path.suffix))
        words += ["--source", "recorded", "--sweeps", record["path"]]
        words += [] if table is None else ["--pointing", str(table)]
    else:
        words += ["--scene", source, *([] if wavelengths is None else ["--wavelengths", wavelengths])]
    if record["wavelength_nm"] is None:
        words += ["--wavelengths", "NM,NM,..."]
    return shlex.join([*words, "--weights", "WEIGHTS.safetensors"])


def _stamps(source: CubeSource) -> list[tuple[int, int]]:
    return [(path.stat().st_size, path.stat().st_mtime_ns) for path in source.files]


def _key(name: str | None, source: CubeSource, files: Sequence[SourceFile]) -> dict[str, Any]:
    """Return the parameters of the store: content, flags and wavelengths."""
    named = source.root is not None  # names of chunks or parts are content
    centres, widths = source.bands.wavelength_nm, source.bands.fwhm_nm
    return {
        "files": [[file.name if named else "", file.size, file.sha256] for file in files],
        "shape": source.shape,
        "name": name,
        "references": [source.dark, source.white],
        "wavelength_nm": None if centres is None else centres.tolist(),
        "fwhm_nm": None if widths is None else widths.tolist(),
        **georeference_record(source.geobox),
        **({"scaling": source.scaling} if source.scaling else {}),
        **({"bad_bands": source.bad_bands} if source.bad_bands else {}),
        **({} if source.void is None else {"gaps": True}),
    }


def _record(
    archive: Archive, ref: StageRef, source: CubeSource, files: Sequence[SourceFile], *, cached: bool
) -> dict[str, Any]:
    centres = source.bands.wavelength_nm
    return {
        "stage": ref.stage,
        "key": ref.key,
        "uri": ref.uri,
        "path": f"{archive.name}/{ref.uri}",
        "cached": cached,
        "name": source.name,
        "shape": list(source.shape),
        "source_dtype": source.dtype.str,
        "lost_lines": source.lost_lines,
        "wavelength_nm": None if centres is None else [float(centres.min()), float(centres.max())],
        "dark": source.dark is not None,
        "white": source.white is not None,
        "georeferenced": source.geobox is not None,
        "bytes_read": sum(file.size for file in files),
        "bytes_stored": archive.stored_bytes(ref),
        "files": [asdict(file) for file in files],
        "notes": list(source.notes),
    }


def _print(record: dict[str, Any], source: CubeSource, console: Console) -> None:
    lines, samples, bands = record["shape"]
    span = record["wavelength_nm"]
    light = "no wavelengths (give --wavelengths)" if span is None else f"{span[0]:g}-{span[1]:g} nm"
    console.print(f"{escape(record['name'])}: {lines} x {samples} px, {bands} bands, {light}", soft_wrap=True)
    for note in (*source.notes, *([source.bands.origin] if source.bands.origin else [])):
        console.print(f"[dim]note: {escape(note)}[/]", soft_wrap=True)
    if record["lost_lines"]:
        console.print(f"[yellow]{record['lost_lines']} of {lines} lines are in no file and flagged[/]")
    done = "already there" if record["cached"] else "stored"
    sizes = f"{record['bytes_read'] / 1e6:.1f} MB read, {record['bytes_stored'] / 1e6:.1f} MB stored"
    console.print(f"{done}: {escape(record['path'])} ({sizes})", soft_wrap=True)
