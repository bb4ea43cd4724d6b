"""Who uses an archive in a bucket: an object of each user's own, as locks reach no further than one machine.

Whoever comes writes first and looks then, so that of one who wants to be alone and another at least one sees the other.
Ages are told from the store's own dates alone: no two clocks are compared.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

from pipeline.errors import ArchiveError
from storage.archive.staging import take_lock
from storage.remote.object_stores import Objects

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

    Others wait for one who is alone.

    Raises
    ------
    ArchiveError : whoever is alone does not end.
    """
    end_dead_leases(objects, root)
    name = f"{'alone' if alone else 'shared'}-{secrets.token_hex(8)}"
    unlock = take_lock(_lock(root, name))  # waits, if for that of another who looks whether somebody is behind it
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


def _lock(root: Path, name: str) -> Path:
    return root / FOLDER / f"{name}.lock"
