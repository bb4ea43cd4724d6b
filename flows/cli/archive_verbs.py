"""Verbs on an archive: what is in it, how it came about, is it whole, what can go, in and out of it."""

from __future__ import annotations

from pathlib import Path

from flows.cli.app import (
    ArchiveName,
    AsJson,
    OutFile,
    OutFolder,
    Scheduler,
    Switch,
    Workers,
    app,
    parse_numbers,
    stderr,
)
from flows.terminal.shown_text import print_json


@app.command
def ls(archive: ArchiveName, *, as_json: AsJson = False) -> int:
    """List the runs and stores of an archive: when, what of, how good, how large."""
    from flows.archive.commands import run_ls

    return run_ls(archive, as_json=as_json)


@app.command
def explain(archive: ArchiveName, product: str, *, as_json: AsJson = False) -> int:
    """Show how a product came about, and what changed since the version before it.

    Parameters
    ----------
    product
        Its address (stages/rectify/KEY), a key or its beginning, a run's name or `latest`, or a product's name in the
        newest run (class_map, mosaic).
    """
    from flows.archive.commands import run_explain

    return run_explain(archive, product, as_json=as_json)


@app.command
def verify(archive: ArchiveName, *, repair: Switch = False, as_json: AsJson = False) -> int:
    """Read every byte of an archive again and compare it with what was published.

    Parameters
    ----------
    repair
        Make anew what is broken and what was made of it, by running the surveys again that name it.
    """
    from flows.archive.commands import run_verify

    return run_verify(archive, stderr, remake=repair, as_json=as_json)


@app.command
def gc(
    archive: ArchiveName,
    *,
    keep_days: float = 1.0,
    raw_too: Switch = False,
    dry_run: Switch = False,
    as_json: AsJson = False,
) -> int:
    """Remove what no run names and no named product rests on.

    Parameters
    ----------
    keep_days
        Stores younger than this stay: a survey may be about to name them.
    raw_too
        Also raw lines of a rig, or ingested, that no run names; they cannot be had again.
    dry_run
        Only say what would go, and how many bytes.
    """
    from flows.archive.commands import run_gc

    return run_gc(archive, stderr, keep_days=keep_days, raw_too=raw_too, dry_run=dry_run, as_json=as_json)


@app.command
def export(
    archive: ArchiveName, run: str | None = None, *, out: OutFile, envi: Switch = False, as_json: AsJson = False
) -> int:
    """Export a run: maps as cloud-optimised GeoTIFF, a STAC catalogue of them, and on request cubes as ENVI.

    Parameters
    ----------
    run
        The run's name, a folder's below runs, or `latest`, as without one.
    out
        Folder to export into, beside the runs of the same archive that lie there.
    envi
        Also write the coarse mosaic and the raw sweeps as ENVI files.
    """
    from flows.archive.export_command import run_export

    content = run_export(archive, run, out, envi, stderr)
    if as_json:
        print_json(content)
    return 0


@app.command
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
        ENVI header or data file, folder of a Headwall camera, GeoTIFF, .mat, .npy, PNG, or Zarr store.
    name
        What the cube is called; the file's or folder's name by default.
    dark
        Dark frame, ENVI or .npy, averaged over its lines; a Headwall folder's own by default.
    white
        White frame, likewise.
    wavelengths
        Centre wavelengths of all bands [nm], where the files do not say them: 660,800
    """
    from flows.archive.ingest_command import IngestRequest, run_ingest

    request = IngestRequest(source, archive, name, dark, white, parse_numbers(wavelengths, "--wavelengths"))
    record = run_ingest(request, stderr)
    if as_json:
        print_json(record)
    return 0


@app.command
def compare(archive: ArchiveName, old: str, new: str, *, out: OutFolder = None, as_json: AsJson = False) -> int:
    """Compare two runs of one field: classes, where they differ, what was asked and spent, and a picture.

    Parameters
    ----------
    old
        Run A: its name, a folder's below runs, `latest`, or `previous`, the one before it of the same field.
    new
        Run B, likewise.
    out
        Folder for the picture; beside the archive without one.
    """
    from flows.archive.compare_command import run_compare

    return run_compare(archive, old, new, out, as_json=as_json)


@app.command
def reprocess(
    archive: ArchiveName,
    *,
    since: str | None = None,
    stage: str | None = None,
    field: str | None = None,
    failed: Switch = False,
    weights: Path | None = None,
    scheduler: Scheduler = "threads",
    workers: Workers = None,
    dry_run: Switch = False,
    out: OutFolder = None,
    as_json: AsJson = False,
) -> int:
    """Survey every field of an archive again: light is found there, only what has changed is made anew.

    Parameters
    ----------
    since
        Only fields whose newest run is of this date (UTC) or later: 2026-05-01
    stage
        Only where this stage would be made anew: segment, draw_map
    field
        Only fields whose survey, scene file or newest run is called so; * stands for any letters.
    failed
        Only fields whose newest run is damaged or lacks stores; what `verify` finds in bytes is for its --repair.
    weights
        Other model weights for all of them.
    dry_run
        Only say what would run.
    out
        Folder for the summary, reprocess-TIME.json; without one beside the archive, where anything was to be done.
    """
    from flows.archive.reprocess_command import ReprocessRequest, run_reprocess
    from storage.parallel.crew import Crew

    crew = Crew(scheduler, workers)
    request = ReprocessRequest(archive, since, stage, field, failed, weights, dry_run, out, crew)
    return run_reprocess(request, stderr, as_json=as_json)
