"""Copy an archive to a bucket and back: the verbs `push` and `pull`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.settings.flags import ArchiveName, AsJson
from spectralzoom.flows.terminal.figures import counted, format_bytes
from spectralzoom.flows.terminal.processes import DONE, PARTLY
from spectralzoom.flows.terminal.progress import StageProgress, put_out, stderr
from spectralzoom.storage.remote import bucket
from spectralzoom.storage.remote.objects import Objects
from spectralzoom.storage.store import Archive

BucketName = Annotated[str, Parameter(name="bucket", help="Address in a bucket: s3://bucket/prefix.")]


def push(archive: ArchiveName, to: BucketName, *, as_json: AsJson = False) -> int:
    """Copy the stores and runs of an archive that a bucket lacks into it."""
    opened, objects = Archive.open(archive, create=False), Objects(to)
    with StageProgress(stderr, {"push": "sending"}) as bars:
        copied = bucket.push(opened, objects, lambda uri, part: bars.show("push", part, uri))
    return _report(copied, as_json=as_json)


def pull(source: BucketName, archive: ArchiveName, *, run: str | None = None, as_json: AsJson = False) -> int:
    """Copy the stores and runs of a bucket that an archive lacks into it; create the archive if it is not there.

    Parameters
    ----------
    run
        Copy only this run (its name, or `latest`), with the stores that it names.
    """
    objects, opened = Objects(source), Archive.open(archive)
    with StageProgress(stderr, {"pull": "fetching"}) as bars:
        copied = bucket.pull(objects, opened, lambda uri, part: bars.show("pull", part, uri), run)
    return _report(copied, as_json=as_json)


def _report(copied: bucket.Copied, *, as_json: bool) -> int:
    put_out(asdict(copied), show_copied, as_json=as_json)
    return PARTLY if copied.conflicts or copied.missing or copied.bad_names else DONE


def show_copied(content: Mapping[str, Any], console: Console) -> None:
    """Print how many stores and runs were copied, and their size."""
    runs = sum(uri.startswith("runs/") for uri in content["copied"])
    stores = len(content["copied"]) - runs
    console.print(
        f"Copied {counted(stores, 'store')} and {counted(runs, 'run')} ({format_bytes(content['bytes'])}); "
        f"{content['there']} were there.",
        soft_wrap=True,
    )
    for uri in content["conflicts"]:
        console.print(f"{uri} was not copied: the other side has it with other content.", soft_wrap=True)
    for uri in content["missing"]:
        console.print(f"{uri}, which a copied run names, is in neither place.", soft_wrap=True)
    for name in content["bad_names"]:
        console.print(
            f"{escape(name)!r} in the bucket has a name that no client can ask for: remove it.", soft_wrap=True
        )
