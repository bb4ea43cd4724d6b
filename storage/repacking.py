"""Packing old raw sweeps: the same numbers under the same key in fewer bytes, with the codec of the archive tier.

A store is made anew beside itself, read back, sealed and synced; then the two exchange their names in one step, and
what was the store before goes. Killed anywhere, one of the two lies whole under the key. The new manifest says which
one it had before, so that runs which know that one know this one too.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.errors import ArchiveError, IncompleteStoreError, SettingsError
from storage.archive.addresses import StageRef
from storage.archive.archive import Archive
from storage.archive.folder_exchange import exchange
from storage.archive.lineage import RAW_STAGES, Catalogue
from storage.archive.manifests import (
    check_files,
    listed_bytes,
    manifest_sha256,
    packed_facts,
    read_manifest,
    write_manifest,
)
from storage.archive.records import Store
from storage.archive.staging import PART_SUFFIX, files_below, refusals, remove_tree, take_lock
from storage.archive_codec import PCODEC_LEVEL, PCODEC_NAME
from storage.packed_arrays import is_packed, pack_array, raw_array

DAY_S = 86400.0
IN_USE = "somebody is using the archive: run pack again when it is free"
PACKED_ALREADY = "packed already"
GIVE_WAY_S = 0.1  # between two stores: whoever waits for the archive takes it now, and pack stops
LEAST_SAVED = 0.01  # of a store's bytes, for which it is worth another manifest
State = Literal["packed", "to pack", "skipped", "failed"]
Progress = Callable[[str, float], None]  # address of what is being packed, how far of all bytes, 0..1


@dataclass(frozen=True)
class Packing:
    """What packing did with one store, or would do. Sizes are of the store's files [bytes]."""

    uri: str
    state: State
    before: int
    after: int | None = None  # None where it was not packed
    why: str = ""


@dataclass(frozen=True)
class Packed:
    """What packing did, store by store; ``obstacle`` says why it did not go on, or is None."""

    stores: tuple[Packing, ...]
    obstacle: str | None = None

    @property
    def saved(self) -> int:
        """Bytes that were saved."""
        return sum(one.before - one.after for one in self.stores if one.after is not None)


def plan_packing(archive: Archive, *, older_than: float = 30.0, now: datetime | None = None) -> list[Packing]:
    """Tell for every raw store whether it can be packed, and if not, why.

    Parameters
    ----------
    older_than
        Days since a store was made; younger ones are left as they are.

    Raises
    ------
    SettingsError : ``older_than`` is negative or no number.
    ArchiveError : the archive is in a bucket.
    """
    if archive.in_bucket:
        raise ArchiveError(
            f"{archive.name} is in a bucket, where no store can change: copy it to a disk, pack it there"
        )
    if not (math.isfinite(older_than) and older_than >= 0):
        raise SettingsError(f"--older-than {older_than}: expected a number of days, 0 or more")
    moment = now or datetime.now(UTC)
    stores = Catalogue.read(archive.root).stores
    return [_plan(store, older_than, moment) for uri, store in stores.items() if uri.split("/")[1] in RAW_STAGES]


def pack(
    archive: Archive,
    *,
    older_than: float = 30.0,
    now: datetime | None = None,
    progress: Progress = lambda uri, done: None,
) -> Packed:
    """Pack what `plan_packing` finds, one store after the other; between two of them others may use the archive.

    Raises
    ------
    SettingsError : ``older_than`` is negative or no number.
    ArchiveError : the disk refuses, or cannot exchange two folders in one step; the archive is in a bucket.
    """
    with refusals(archive.root, "pack the archive"):
        plan = plan_packing(archive, older_than=older_than, now=now)
        total, done = sum(one.before for one in plan if one.state == "to pack") or 1, 0
        made: list[Packing] = []
        archive.reclaim()  # what a pack that was killed has left beside its store
        for number, one in enumerate(plan):
            if one.state == "to pack":
                begin = done / total

                def report(share: float, one: Packing = one, begin: float = begin) -> None:
                    progress(one.uri, begin + share * one.before / total)

                if done:
                    time.sleep(GIVE_WAY_S)
                with archive.in_use(alone=True) as alone:
                    if not alone:
                        return Packed((*made, *plan[number:]), IN_USE)
                    one, done = _packed(archive, one, report), done + one.before
            made.append(one)
    return Packed(tuple(made))


def _plan(store: Store, older_than: float, now: datetime) -> Packing:
    uri, size = store.ref.uri, store.size
    if store.problem is not None:
        return Packing(uri, "failed", size, why=f"{store.problem}; run verify --repair")
    if _age_days(store, now) < older_than:
        return Packing(uri, "skipped", size, why=f"younger than {older_than:g} days")
    try:
        why = _why_not(store.ref.path)
    except IncompleteStoreError as error:
        return Packing(uri, "failed", size, why=str(error))
    return Packing(uri, "skipped" if why else "to pack", size, why=why)


def _age_days(store: Store, now: datetime) -> float:
    """Days since a store was made; one that does not tell is as old as its manifest."""
    try:
        made = datetime.fromisoformat(store.created)
    except ValueError:
        made = datetime.fromtimestamp((store.ref.path / "manifest.json").stat().st_mtime, UTC)
    return (now - (made if made.tzinfo else made.replace(tzinfo=UTC))).total_seconds() / DAY_S


def _why_not(folder: Path) -> str:
    """Why nothing of a store can be packed; empty where something can."""
    reasons = [why for cube in sorted(folder.glob("*.zarr")) if (why := _cube_why_not(cube)) is not None]
    return "" if "" in reasons else next(iter(dict.fromkeys(reasons)), "holds no raw numbers")


def _cube_why_not(cube: Path) -> str | None:
    """Why a cube cannot be packed, empty where it can; None where it is no raw cube."""
    array = raw_array(cube)
    if array is None:
        return None
    if is_packed(array):
        return PACKED_ALREADY
    if array.dtype != np.uint16:
        return f"holds {array.dtype}: only uint16 is packed, raw numbers as a camera gives them"
    return "" if array.shards is not None else "is not stored in shards: only what this program stored is packed"


def _packed(archive: Archive, one: Packing, report: Callable[[float], None]) -> Packing:
    """Pack one store, or tell why it stays as it is."""
    _, stage, key = one.uri.split("/")
    ref = StageRef(stage, key, archive.root / one.uri)
    release = take_lock(archive.root / ".locks" / f"{stage}-{key}.lock", wait=False)
    if release is None:
        return replace(one, state="failed", why="another process works on it")
    try:
        check_files(ref.path, hashes=True)  # what is broken must not get a new seal
        return _exchange_packed(ref, one, report)
    except IncompleteStoreError as error:
        return replace(one, state="failed", why=str(error))
    finally:
        remove_tree(_part(ref))
        release()


def _exchange_packed(ref: StageRef, one: Packing, report: Callable[[float], None]) -> Packing:
    part = _part(ref)
    remove_tree(part)
    values = _write_packed(ref.path, part, report)
    before = read_manifest(ref.path)
    write_manifest(part, packed_facts(before, manifest_sha256(ref.path), values, f"{PCODEC_NAME} level {PCODEC_LEVEL}"))
    made = read_manifest(part)
    _check_copies(ref.path, before["files"], made["files"])
    after = listed_bytes(made)
    if after > (1 - LEAST_SAVED) * one.before:
        return replace(one, state="skipped", why=f"would save less than {LEAST_SAVED:.0%}")
    exchange(part, ref.path)
    return replace(one, state="packed", after=after)


def _check_copies(store: Path, before: Mapping[str, Any], made: Mapping[str, Any]) -> None:
    """Refuse to seal files that changed on their way (IncompleteStoreError); those of the packed arrays are new."""
    arrays = tuple(f"{cube.name}/{_name(cube)}/" for cube in sorted(store.glob("*.zarr")) if _cube_why_not(cube) == "")
    for name in sorted(set(before) | set(made)):
        if not name.startswith(arrays) and before.get(name) != made.get(name):
            raise IncompleteStoreError(f"{store / name} changed while it was copied; check the disk, pack again")


def _write_packed(store: Path, part: Path, report: Callable[[float], None]) -> dict[str, str]:
    """Make the packed store in ``part``, but for its manifest; gives the hash of each packed cube's numbers."""
    cubes = [cube for cube in sorted(store.glob("*.zarr")) if _cube_why_not(cube) == ""]
    arrays = {cube: _name(cube) for cube in cubes}
    for path in _others(store, [cube / name for cube, name in arrays.items()]):
        copy = part / path.relative_to(store)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    hashes: dict[str, str] = {}
    for number, cube in enumerate(cubes):
        hashes[cube.name] = pack_array(
            cube,
            part / cube.name,
            lambda done, number=number: report((number + done) / len(cubes)),  # type: ignore[misc]
        )
    return hashes


def _name(cube: Path) -> str:
    array = raw_array(cube)
    assert array is not None
    return array.basename


def _others(store: Path, packed: list[Path]) -> Iterator[Path]:
    """Files of a store but its manifest and those of the arrays that are packed."""
    return (path for path in files_below(store) if not any(path.is_relative_to(array) for array in packed))


def _part(ref: StageRef) -> Path:
    return ref.path.with_name(ref.key + PART_SUFFIX)
