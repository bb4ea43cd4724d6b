"""Who uses an archive in a bucket, what of it is broken, and what broken-off uploads have left there.

A lease is an object of each user's own, as locks reach no further than one machine. Whoever comes writes first and
looks then, so that of one who wants to be alone and another at least one sees the other. Ages are told from the
store's own dates alone: no two clocks are compared.
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.errors import ArchiveError
from storage.archive.manifests import try_manifest
from storage.archive.records import RECEIPT
from storage.archive.staging import MANIFEST_NAME, refusals, take_lock
from storage.maintenance.verification import Finding, Progress, name_damage, verify_everything
from storage.remote.object_stores import Listed, Objects, some_at_a_time
from storage.remote.object_transfers import ATTEMPT, BEGUN, WITHDRAWN, files_at, is_address

FOLDER = ".in-use"
LIFE_S = 86400.0  # after this, nobody is thought to be behind a lease that was not renewed
RENEW_S = 3600.0
WAIT_S = 60.0
_PAUSE_S = 1.0


class Lease:
    """A lease that is held, and the local lock that tells this machine's next process whether somebody still is."""

    def __init__(self, objects: Objects, name: str, unlock: Callable[[], None]) -> None:
        self._objects, self._name, self._unlock, self._since = objects, name, unlock, time.monotonic()
        self.taken: datetime | None = None  # by the store's clock, rounded up: it tells whole seconds

    def renew(self) -> None:
        """Write it again, now and then: called whenever something is published."""
        if time.monotonic() - self._since > RENEW_S:
            self._objects.write(self._name, b"renewed")
            self._since = time.monotonic()

    def end(self) -> None:
        """Take it away."""
        try:
            self._objects.remove([self._name])
        finally:
            self._unlock()


def take_lease(objects: Objects, root: Path, *, alone: bool) -> Lease | None:
    """Say that an archive is in use; None, at once, where ``alone`` is asked and somebody else uses it.

    Others wait for one who is alone. Raises ArchiveError: whoever is alone does not end.
    """
    end_dead_leases(objects, root)
    name = f"{'alone' if alone else 'shared'}-{secrets.token_hex(8)}"
    unlock = take_lock(
        root / FOLDER / f"{name}.lock"
    )  # waits, if for that of another who looks whether somebody is behind it
    assert unlock is not None
    lease, until = Lease(objects, f"{FOLDER}/{name}", unlock), time.monotonic() + WAIT_S
    try:
        objects.create(f"{FOLDER}/{name}", b"taken")
        while others := _others(objects, lease, name, alone=alone):
            if alone:
                lease.end()
                return None
            if time.monotonic() > until:
                raise ArchiveError(
                    f"{objects.place.url} is being cleared up or repaired elsewhere ({others[0]}); run again when that "
                    "has ended, or remove this object if it was killed"
                )
            time.sleep(_PAUSE_S)
    except BaseException:
        lease.end()
        raise
    return lease


def _others(objects: Objects, lease: Lease, name: str, *, alone: bool) -> list[str]:
    """Leases of others that stand against one's own."""
    found = objects.listing(FOLDER)
    own = found.pop(f"{FOLDER}/{name}", None)
    if own is None:  # taken away as dead, while a clock jumped or this machine slept: not held any more
        objects.create(f"{FOLDER}/{name}", b"taken again")
        return [f"{FOLDER}/{name}"]
    lease.taken = own.changed + timedelta(seconds=1)
    fresh = [other for other, one in found.items() if (own.changed - one.changed).total_seconds() < LIFE_S]
    return sorted(other for other in fresh if alone or other.startswith(f"{FOLDER}/alone-"))


def end_dead_leases(objects: Objects, root: Path) -> None:
    """Take away the leases of processes of this working copy that were killed."""
    for path in sorted((root / FOLDER).glob("*.lock")):
        unlock = take_lock(path, wait=False)
        if unlock is not None:
            try:
                objects.remove([f"{FOLDER}/{path.stem}"])
            finally:
                unlock()


DAY_S = 86400.0
_BEGUN = re.compile(rf"(runs/[^/]+)/{BEGUN}")


def verify_objects(objects: Objects, progress: Progress | None = None) -> list[Finding]:
    """Check every store and run in a bucket; a finding for each that is whole, and for each thing that is not.

    Nothing is taken from a working copy: manifests and receipts are fetched again, into a folder that goes away.
    """
    there = objects.listing()
    with TemporaryDirectory(prefix="spectralzoom-verify-") as named, refusals(Path(named), "read manifests into"):
        root = Path(named)
        (root / "stages").mkdir()
        depths = {"stages": 4, "runs": 3}
        manifests = [path for path in there if path.endswith(f"/{MANIFEST_NAME}") and is_address(path)]
        manifests = [path for path in manifests if depths.get(path.split("/")[0]) == path.count("/") + 1]
        published = [path.removesuffix(f"/{MANIFEST_NAME}") for path in manifests]
        some_at_a_time(lambda uri: _lay_out(objects, root, uri), published)

        def problems(folder: Path) -> Iterator[str]:
            uri = folder.relative_to(root).as_posix()
            text = (folder / MANIFEST_NAME).read_bytes()
            found = list(_problems(objects, there, folder, files_at(uri, text)))
            if found and objects.read(f"{uri}/{MANIFEST_NAME}") == text:  # else it was cleared away since, or made anew
                yield from found

        return [*verify_everything(root, progress, problems), *_broken_off(objects, there)]


def _broken_off(objects: Objects, there: Mapping[str, Listed]) -> Iterator[Finding]:
    """What a repair left withdrawn, and runs without a manifest, unless somebody may be about to upload it."""
    for path in there:
        if path.startswith(f"{WITHDRAWN}/"):
            yield Finding(path, "a repair was broken off; run verify --repair again", "stray")
    if not any(path.startswith(f"{FOLDER}/") for path in there):
        for uri in find_lost_runs(there):
            if objects.read(f"{uri}/{MANIFEST_NAME}") is None:
                yield Finding(uri, f"{MANIFEST_NAME} is missing, or its upload was broken off", "broken")


def _lay_out(objects: Objects, root: Path, uri: str) -> None:
    """Manifest, and receipt as it is, of what is published at an address."""
    text = objects.read(f"{uri}/{MANIFEST_NAME}")
    if text is None:
        return
    (root / uri).mkdir(parents=True)
    (root / uri / MANIFEST_NAME).write_bytes(text)
    if uri.startswith("runs/") and (receipt := objects.read(f"{files_at(uri, text)}/{RECEIPT}")) is not None:
        (root / uri / RECEIPT).write_bytes(receipt)


def _problems(objects: Objects, there: Mapping[str, Listed], folder: Path, place: str) -> Iterator[str]:
    """What is wrong with one published folder, whose files lie at ``place``, object by object."""
    manifest, problem = try_manifest(folder)
    if problem is not None:
        yield f"{MANIFEST_NAME} cannot be believed: {problem}"
        return
    for name, entry in manifest["files"].items():
        problem = _object_problem(objects, there, f"{place}/{name}", entry)
        if problem is None:
            continue
        about = [f"{parent.as_posix()}/zarr.json" for parent in Path(name).parents if parent != Path()]
        for one in (name, *about):  # which part of an array it is, and which of its chunks can be read
            try:
                objects.save(f"{place}/{one}", folder / one)
            except FileNotFoundError:
                (folder / one).unlink(missing_ok=True)
        yield f"{name} {problem}{name_damage(folder, name)}"
    extra = {path.removeprefix(f"{place}/") for path in there if path.startswith(f"{place}/")} - set(manifest["files"])
    yield from (f"{name} is not in the manifest: take it out of the archive" for name in sorted(extra))


def _object_problem(objects: Objects, there: Mapping[str, Listed], name: str, entry: Mapping[str, Any]) -> str | None:
    if name not in there:
        return "cannot be read: it is missing"
    if there[name].size != entry["size"]:
        return f"has {there[name].size} bytes, expected {entry['size']}"
    try:
        _, digest = objects.measure(name)
    except FileNotFoundError:
        return "cannot be read: it is missing"
    return None if digest == entry["sha256"] else "has changed since it was published (its SHA-256 differs)"


def find_lost_runs(there: Iterable[str]) -> list[str]:
    """Runs of which there are files, but no manifest: it was lost, or their upload was broken off."""
    found = {folder.rpartition("/")[0] for path in there if (folder := _attempt(path)) and path.startswith("runs/")}
    return sorted(uri for uri in found - {path.removesuffix(f"/{MANIFEST_NAME}") for path in there} if is_address(uri))


def find_leftovers(objects: Objects, keep_days: float) -> dict[str, int]:
    """Files of stores that no manifest publishes, and runs that were but begun, older than ``keep_days``; their bytes.

    What a repair has withdrawn is published yet. Ages are told from the store's own dates, up to the youngest object:
    the lease of whoever clears up.
    """
    there = objects.listing()
    now = max((one.changed for one in there.values()), default=None)
    found: dict[str, int] = {}
    for folder, files in sorted(_parts(there).items()):
        assert now is not None
        age = (now - max(one.changed for one in files)).total_seconds()
        if age >= keep_days * DAY_S and not _is_published(objects, there, folder):
            found[folder] = sum(one.size for one in files)
    return found


def _parts(there: Mapping[str, Listed]) -> dict[str, list[Listed]]:
    """Folders of one upload's files, but those of lost runs, and runs of which nothing but their beginning is there."""
    lost, found = find_lost_runs(there), dict[str, list[Listed]]()
    more = {"/".join(path.split("/")[:2]) for path in there if not path.endswith(f"/{BEGUN}")}
    begun = {named[1] for path in there if (named := _BEGUN.fullmatch(path))} - more
    for path, one in there.items():
        run = path.removesuffix(f"/{BEGUN}")
        folder = run if run in begun else _attempt(path)
        if folder is not None and folder.rpartition("/")[0] not in lost:
            found.setdefault(folder, []).append(one)
    return found


def _attempt(path: str) -> str | None:
    """The folder of one upload's files that an object belongs to."""
    parts = path.split("/")
    depth = {"stages": 3, "runs": 2}.get(parts[0], len(parts))
    return "/".join(parts[: depth + 1]) if len(parts) > depth + 1 and ATTEMPT.fullmatch(parts[depth]) else None


def _is_published(objects: Objects, there: Mapping[str, Listed], folder: str) -> bool:
    uri = folder.rpartition("/")[0]
    manifests = [name for name in (f"{uri}/{MANIFEST_NAME}", f"{WITHDRAWN}/{uri}/{MANIFEST_NAME}") if name in there]
    texts = [text for name in manifests if (text := objects.read(name)) is not None]
    return any(files_at(uri, text) == folder for text in texts)
