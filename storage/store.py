"""Keep an archive: immutable stores, one folder for each stage and key, and one folder for each run.

::

    stages/<stage>/<key>/         what a stage made, and manifest.json: parameters, inputs, hashes of all files
    stages/<stage>/<key>.cleared  the manifest of a store whose folder was deleted
    runs/<name>/                  receipt, report and pictures of a survey, with the same kind of manifest
    spool/<key>/                  lines of a capture under way
    .locks/                       held while something is made

A folder is written under another name (``.part``), synced, and renamed; to delete it, it is renamed first. So a kill at
any moment leaves either the whole store or a leftover that `Archive.reclaim` removes. Published files never change.
Every opening of a store compares the names and sizes of its files, the SHA-256 of all but the chunks of arrays, and the
digests of its inputs. Chunks have a checksum of their own.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import math
import os
import re
import shlex
import stat
import tempfile
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import UTC, date, datetime
from itertools import count
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, NoRunError, list_some
from spectralzoom.pipeline.words import CLEARED, PART, UNFINISHED, is_name
from spectralzoom.storage.whole_files import (
    aside,
    bytes_in,
    check_no_link,
    entries,
    files_in,
    is_folder,
    locked,
    make_folder,
    open_own,
    read_own,
    refusals,
    remove,
    sha256,
    sync,
    write_new,
)

MANIFEST = "manifest.json"
RESTS_ON = "rests_on"  # of a manifest: address of each input, for a run of every store below it -> `manifest_digest`
LATEST = "latest"
KEY_LENGTH = 20
SECOND = len("20261120T101701")  # of a run's name: when it was begun
MOST_LOOKS = 5
CLOCK_S = 2.0  # clocks of two machines differ by less
CAPTURED = "capture"  # lines as they came; "condense" and "condense_fine": the same, compressed
_BUCKET = re.compile(r"(?i)[a-z][a-z0-9+]+:(?=/)")
_CHUNK = re.compile(r".*\.zarr/.*/c[/.][0-9/.]+")  # of an array; each has a crc32c (arrays.layout)

log = logging.getLogger(__name__)


# --- keys -------------------------------------------------------------------------------------------------------------


def plain(value: object) -> Any:
    """Return a parameter in JSON types.

    Floats keep 12 digits, 2.0 is 2, NaN and infinities are text. An array is the hash of its bytes; an object with a
    ``key`` is that key. Raises ArchiveError: the value has no lasting text, such as a function.
    """
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        if not math.isfinite(value):
            return f"{value}"
        short = float(f"{value:.12g}")
        return int(short) if short.is_integer() and abs(short) < 2.0**53 else short
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, np.ndarray) and value.dtype.kind != "O":
        return [value.dtype.str, list(value.shape), hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if hasattr(value, "key") and not isinstance(value, type):
        return plain(value.key)
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if hasattr(value, "model_dump"):
        return plain(value.model_dump())
    if isinstance(value, Sequence) and not isinstance(value, bytes):
        return [plain(one) for one in value]
    raise ArchiveError(f"{type(value).__name__} {value!r} cannot be part of a key; give numbers, text, lists or tables")


def text_of(facts: object) -> str:
    """Return the same text for the same meaning: sorted names, short numbers, no spaces."""
    return json.dumps(plain(facts), sort_keys=True, separators=(",", ":"), allow_nan=False)


def stage_key(stage: str, version: int, params: Mapping[str, Any], inputs: Sequence[Ref] = ()) -> str:
    """Return the key of a stage's store; the order of inputs counts, that of parameters does not."""
    facts = {"stage": stage, "version": version, "params": params, "inputs": [one.key for one in inputs]}
    return hashlib.sha256(text_of(facts).encode()).hexdigest()[:KEY_LENGTH]


def array_digest(array: NDArray[np.generic]) -> str:
    """Return a hash of an array's shape and values."""
    return hashlib.sha256(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes()).hexdigest()[:KEY_LENGTH]


@dataclass(frozen=True)
class Ref:
    """Address of a store: what tasks pass on instead of arrays."""

    stage: str
    key: str
    path: Path = field(compare=False)

    @property
    def uri(self) -> str:
        """Address relative to the archive."""
        return f"stages/{self.stage}/{self.key}"


def uri_of(address: str) -> str | None:
    """Return ``stages/STAGE/KEY`` or ``runs/NAME`` of an address of it or of a file in it; None for other text."""
    parts = address.split("/")
    count = {"stages": 3, "runs": 2}.get(parts[0], len(parts) + 1)
    return "/".join(parts[:count]) if len(parts) >= count and all(map(is_name, parts)) else None


def write_table(path: Path, content: Mapping[str, Any]) -> None:
    """Write plain values in their own order; numpy's numbers become floats."""
    write_new(path, json.dumps(content, indent=1, default=float) + "\n")


def read_table(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file directly in a published store.

    Raises IncompleteStoreError: the file is not in the store's manifest, or differs from it.
    """
    entry = read_manifest(path.parent)["files"].get(path.name)
    problem = "is in no manifest" if entry is None else file_problem(path, *entry)
    if problem is not None:
        raise damage(path.parent, f"{path.name} {problem}")
    return cast(dict[str, Any], json.loads(read_own(path)))


# --- manifests --------------------------------------------------------------------------------------------------------


_EMPTY: Mapping[str, Any] = {"files": {}, "params": {}, "inputs": [], RESTS_ON: {}, "settings": {}, "created": ""}


def write_manifest(folder: Path, facts: Mapping[str, Any]) -> None:
    """Write the manifest of a folder, with sizes and hashes of its files beside ``facts``."""
    files = {name: [one.st_size, sha256(folder / name, open_own)] for name, one in sorted(files_in(folder).items())}
    created = datetime.now(UTC).isoformat()  # to the microsecond: no two stores have one manifest
    write_new(folder / MANIFEST, manifest_text({"created": created, **facts, "files": files}))


def manifest_text(content: Mapping[str, Any]) -> str:
    """Return the text of a manifest with its ``seal``, by which a flipped bit of the manifest itself is found."""
    content = plain(content)
    return json.dumps({**content, "seal": hashlib.sha256(text_of(content).encode()).hexdigest()}, indent=1) + "\n"


def parse_manifest(written: bytes) -> dict[str, Any]:
    """Return the content of a manifest; tables and lists that it lacks are empty. Raises ValueError: it is damaged."""
    try:
        content = json.loads(written)
        if not isinstance(content, dict):
            raise ValueError("it is no table")
        seal = content.pop("seal", None)
        sealed = json.dumps(content, sort_keys=True, separators=(",", ":"))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if seal != hashlib.sha256(sealed.encode()).hexdigest():
        raise ValueError("it has changed since it was published: its seal does not fit")
    for name, empty in _EMPTY.items():
        if not isinstance(content.setdefault(name, empty), type(empty)):
            raise ValueError(f"its {name} are of another type than expected")
    for name, entry in content["files"].items():
        if not name or name.startswith("/") or "\0" in name or ".." in PurePosixPath(name).parts:
            raise ValueError(f"it lists {name!r}, which is no file of this folder")
        if not (isinstance(entry, list) and [type(one) for one in entry] == [int, str]):
            raise ValueError(f"it gives no size and hash of {name!r}")
    if not all(isinstance(one, str) for one in content[RESTS_ON].values()):
        raise ValueError(f"its {RESTS_ON} has a digest that is no text")
    for uri in (*content["inputs"], *content[RESTS_ON]):
        if not isinstance(uri, str) or uri_of(uri) != uri:
            raise ValueError(f"it names {uri!r}, which is no store")
    return content


def manifest_digest(content: Mapping[str, Any]) -> str:
    """Return a hash of a manifest without its time: equal for stores of equal files that were made of equal inputs."""
    facts = {name: value for name, value in content.items() if name != "created"}
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def is_cleared(folder: Path) -> bool:
    """Return whether a store's folder was deleted, and its manifest kept."""
    return not os.path.lexists(folder) and os.path.lexists(_beside(folder))


def is_known(folder: Path) -> bool:
    """Return whether something was published here, even if its folder was cleared away."""
    return os.path.lexists(folder) or is_cleared(folder)


def _beside(folder: Path) -> Path:
    return folder.with_name(folder.name + CLEARED)


def manifest_path(folder: Path) -> Path:
    """Return the path of the manifest of a store or run, which for a cleared store lies beside its folder."""
    return _beside(folder) if is_cleared(folder) else folder / MANIFEST


def manifest_bytes(folder: Path) -> bytes:
    """Return the manifest of a store or run. Raises OSError: it cannot be read; ValueError: it is no file."""
    path = manifest_path(folder)
    try:
        if not stat.S_ISREG(path.lstat().st_mode):  # a pipe would be waited for
            raise ValueError("it is no file of its own")
        return read_own(path)
    except FileNotFoundError:
        if path == manifest_path(folder):
            raise
        return manifest_bytes(folder)  # it was cleared, or made again, at this moment


def try_manifest(folder: Path) -> tuple[dict[str, Any], str | None]:
    """Return the content of a folder's manifest and None, or an empty manifest and the problem."""
    try:
        if not folder.is_symlink():
            return parse_manifest(manifest_bytes(folder)), None
        problem = "it is a link, expected a folder"
    except FileNotFoundError:
        problem = f"{MANIFEST} is missing" if folder.is_dir() else "it is not there"
    except OSError as error:
        problem = f"{manifest_path(folder).name} cannot be read: {error.strerror or error}"
    except ValueError as error:
        problem = f"{manifest_path(folder).name} is damaged: {error}"
    return dict(_EMPTY), problem


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a published folder. Raises IncompleteStoreError: it is missing or damaged."""
    content, problem = try_manifest(folder)
    if problem is not None:
        raise damage(folder, problem)
    return content


def file_problem(path: Path, size: int, digest: str | None, about: os.stat_result | None = None) -> str | None:
    """Return the difference of a file from size and SHA-256, as text behind its name; None without one."""
    try:
        about = about or path.lstat()
        if not stat.S_ISREG(about.st_mode):
            return "is no file of its own, but a link, folder or pipe"
        if about.st_size != size:
            return f"has {about.st_size} bytes, expected {size}"
        changed = digest is not None and sha256(path, open_own) != digest
        return "has changed since it was published (its SHA-256 differs)" if changed else None
    except OSError as error:
        return "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror or error}"


def problems_of(folder: Path, *, every_byte: bool) -> list[str]:
    """Return the differences of a published folder from its manifest, file by file.

    Chunks of arrays, which have checksums of their own, are read for ``every_byte`` only. A folder that another process
    has cleared or replaced meanwhile is looked at again.
    """
    found: list[str] = []
    for _ in range(MOST_LOOKS):
        before = try_manifest(folder)
        found = _differences(folder, *before, every_byte=every_byte)
        if not found or (before == try_manifest(folder) and not is_cleared(folder)):
            break
    return found


def _differences(folder: Path, manifest: Mapping[str, Any], problem: str | None, *, every_byte: bool) -> list[str]:
    if problem is not None or is_cleared(folder):
        return [problem] if problem is not None else []
    root = _root_of(folder)
    there, found = files_in(folder), conflicts(manifest, lambda uri: digest_of(root / uri), str(root))
    for name, (size, digest) in manifest["files"].items():
        own = None if _CHUNK.fullmatch(name) and not every_byte else digest
        problem = file_problem(folder / name, size, own, there[name]) if name in there else "is missing"
        found += [f"{name} {problem}"] if problem else []
    extra = sorted(there.keys() - {MANIFEST, *manifest["files"]})
    return found + [f"{name} is not in the manifest: take it out of the archive" for name in extra]


def conflicts(manifest: Mapping[str, Any], digest: Callable[[str], str | None], place: str) -> list[str]:
    """Return a problem for each input that ``place`` has with another digest than a manifest states."""
    found = ((uri, stated, digest(uri)) for uri, stated in manifest[RESTS_ON].items())
    return [
        f"it was made of {uri} with digest {stated[:12]}, but {place} has another {uri}, with digest {there[:12]}"
        for uri, stated, there in found
        if stated and there and there != stated
    ]


def digest_of(folder: Path) -> str | None:
    """Return the digest of a store, whose files may be cleared; None if it is not there or its manifest is damaged."""
    content, problem = try_manifest(folder)
    return None if problem else manifest_digest(content)


def check_store(folder: Path, *, every_byte: bool = False) -> None:
    """Compare a published folder with its manifest.

    Raises IncompleteStoreError: it is missing, or a file differs; ArchiveError: it is no folder of the archive.
    """
    check_no_link(folder.absolute().parent, _root_of(folder))
    if folder.is_file():
        raise ArchiveError(f"{folder} is a file, expected the folder of a store or run; take it out of the archive")
    for problem in problems_of(folder, every_byte=every_byte):
        raise damage(folder, problem)


def damage(folder: Path, problem: str) -> IncompleteStoreError:
    """Return the error of a damaged store or run: what was made of it, and the command that removes it."""
    root = _root_of(folder)
    made = descendants(Archive(root).manifests(), [folder.absolute().relative_to(root).as_posix()])
    below = f" and what was made of it, {list_some(made)}," if made else ""
    return IncompleteStoreError(
        f"{folder} is damaged: {problem}; restore it from a copy, or remove it{below} by spectralzoom gc --damaged "
        f"{shlex.quote(str(root))}; the next survey makes it again"
    )


def _root_of(folder: Path) -> Path:
    """Return the archive of a store or run; the folder above where it was copied out of its archive."""
    above = folder.absolute().parents
    is_store = len(above) > 2 and above[1].name == "stages"
    return above[2 if is_store else 1 if above[0].name == "runs" else 0]


# --- the archive ------------------------------------------------------------------------------------------------------


class Archive:
    """A folder of stores and runs; it may be copied as it is, by rsync or to a bucket, at any time."""

    def __init__(self, root: Path) -> None:
        self.root = root

    @classmethod
    def open(cls, root: str | Path, *, create: bool = True, write: bool = True) -> Archive:
        """Open the archive in a folder, or create it with ``create``.

        Raises ArchiveError: the path is a file, a bucket or missing, or cannot be read or written to (``write``).
        """
        path = Path(root).absolute()
        if (found := _BUCKET.match(str(root))) is not None:
            raise ArchiveError(
                f"{found[0]}//{str(root)[found.end() :].lstrip('/')} is not a folder: expected that of an archive; "
                "spectralzoom pull copies one from s3://bucket/prefix, and push copies it there"
            )
        with refusals(path, "use the archive", every=True):
            for part in (path, *(path / name for name in ("stages", "runs", "spool", ".locks"))):
                check_no_link(part, path)
                if not part.is_dir() and os.path.lexists(part):
                    kind = "a link that leads to no folder" if part.is_symlink() else "a file"
                    raise ArchiveError(
                        f"{part} is {kind}, expected a folder for the archive; choose another, or move it"
                    )
            if not (path / "stages").is_dir():
                if not create:
                    state = "is a folder but no archive (it has no folder stages)" if path.is_dir() else "is not there"
                    raise ArchiveError(f"{root} {state}; check the name, or make an archive with survey --out")
                (path / "stages").mkdir(parents=True, exist_ok=True)
                sync(path)
                sync(path.parent)
            try:  # rights alone do not tell of a read-only or full disk
                if write:
                    with tempfile.TemporaryFile(dir=path, buffering=0) as probe:
                        probe.write(b"written to see whether this can be written to")
            except OSError as error:
                if create or error.errno not in (errno.ENOSPC, errno.EDQUOT):  # a full disk is for gc to free
                    raise
        return cls(path)

    @property
    def name(self) -> str:
        """Return the address that opens it again."""
        return str(self.root)

    # --- stores -------------------------------------------------------------------------------------------------------

    def ref(self, stage: str, key: str) -> Ref:
        """Return the address of a store, whether it exists or not. Raises ArchiveError: a name is not allowed."""
        for name in (stage, key):
            if not is_name(name):
                raise ArchiveError(f"{name!r} cannot be a name in an archive; use letters, digits, '_', '-' and '.'")
        return Ref(stage, key, self.root / "stages" / stage / key)

    def refs(self, stage: str | None = None) -> list[Ref]:
        """Return every published store (of one stage), by stage and key."""
        folders = self._folders("stages")
        return [Ref(one.parent.name, one.name, one) for one in folders if stage in (None, one.parent.name)]

    def find(self, stage: str, key: str) -> Ref | None:
        """Return the published store; None where there is none or its files were cleared away.

        Raises IncompleteStoreError: it is damaged.
        """
        ref = self.ref(stage, key)
        with refusals(self.root, "read the archive"):
            try:
                if is_known(ref.path):
                    check_store(ref.path)
            except IncompleteStoreError:
                if is_known(ref.path):  # else gc has removed it meanwhile
                    raise
            return ref if ref.path.is_dir() else None

    def locate(self, address: str) -> Path:
        """Return the path on this machine of a store, a run, or a file in one, by its address.

        Raises IncompleteStoreError: it is missing, damaged or cleared; ArchiveError: it is outside of the archive.
        """
        if (uri := uri_of(address)) is None:
            raise ArchiveError(f"{address!r} is no address in an archive; expected stages/STAGE/KEY or runs/NAME")
        with refusals(self.root, "read the archive"):
            check_store(self.root / uri)
        if is_cleared(self.root / uri):
            raise IncompleteStoreError(
                f"{self.name}/{uri}: its files were cleared away. Run its survey again, for raw lines with --keep raw"
                " (explain prints the command of the run): only cleared stores are built again"
            )
        return self.root / address

    def is_there(self, uri: str) -> bool:
        """Return whether a store has its files, not its manifest alone."""
        return uri_of(uri) is not None and (self.root / uri).is_dir()

    def produce(
        self, stage: str, build: Build, *, version: int, params: Mapping[str, Any], inputs: Sequence[Ref] = ()
    ) -> tuple[Ref, bool]:
        """Return the store with these parameters and inputs, and whether ``build`` has written it now.

        One process at a time builds a store; the others wait for it. Raises ArchiveError: the disk refuses, or another
        process has cleared an input meanwhile.
        """
        ref = self.ref(stage, stage_key(stage, version, params, inputs))
        if self.find(stage, ref.key) is not None:
            return ref, False
        facts = {"stage": stage, "version": version, "params": params, "inputs": [one.uri for one in inputs]}

        def build_of_inputs(folder: Path) -> Mapping[str, Any]:
            paths = [self.root / one.uri for one in inputs]
            before = [None if is_cleared(path) else try_manifest(path) for path in paths]
            try:
                build(folder)
            finally:  # a cleared array reads as nodata, or fails
                same = (old in (None, try_manifest(path)) for path, old in zip(paths, before, strict=True))
                if any(map(is_cleared, paths)) or not all(same):
                    raise ArchiveError(f"another survey has cleared an input of {stage} meanwhile; repeat the command")
            return {**facts, RESTS_ON: {one.uri: digest_of(self.root / one.uri) or "" for one in inputs}}

        with refusals(self.root, "write to the archive"), self._locked(f"{stage}-{ref.key}"):
            if self.find(stage, ref.key) is not None:  # another process was first
                return ref, False
            built = publish(ref.path, build_of_inputs)
            remove(self.root / "spool" / ref.key)
        return ref, built

    def adopt(self, uri: str, copy: Callable[[Path], None] | bytes) -> bool:
        """Publish what ``copy`` writes with its manifest, or the manifest of a cleared store; False if it is here."""
        final = self.root / uri
        with refusals(self.root, "write to the archive"), self._locked(_lock_name(final)):
            if is_known(final):
                return False
            if callable(copy):
                return publish(final, copy)
            _write_beside(final, copy)
            return True

    def clear(self, ref: Ref, *, wait: bool = True) -> bool:
        """Keep the manifest of a store beside its folder, and delete the folder; a later request builds it again.

        False where another process holds it and ``wait`` is false. Raises IncompleteStoreError: its manifest is
        damaged.
        """
        final = self.root / ref.uri
        check_no_link(final.parent, self.root)
        with (
            refusals(self.root, "clear up the archive", every=True),
            self._locked(f"{ref.stage}-{ref.key}", wait=wait) as held,
        ):
            if held:
                read_manifest(final)
                _write_beside(final, manifest_bytes(final))
                remove(final)
        return held

    def discard(self, uri: str) -> bool:
        """Remove a store, a run or a leftover; False where another process holds it, or the disk refuses."""
        path = self.root / uri
        check_no_link(path.parent, self.root)
        with self._locked(_lock_name(path), wait=False) as held:
            if held:
                remove(_beside(path))
                remove(path)
        return held and not is_known(path)

    def in_use(self, *, alone: bool = False) -> AbstractContextManager[bool]:
        """Keep other processes from removing stores while the block runs; many may use an archive at a time.

        ``alone`` asks for exclusive use, and yields False at once where another process uses the archive.
        """
        return self._locked("use", wait=not alone, shared=not alone)

    def reclaim(self) -> list[str]:
        """Remove what killed processes left in this folder; return the addresses."""
        with refusals(self.root, "clear up the archive", every=True):
            return [uri for uri in self.leftovers() if self.discard(uri)]

    def leftovers(self) -> list[str]:
        """Return unfinished folders, and spools of published captures; not those in use."""
        found = [one for one in self._places() if one.name.endswith(PART)]
        whole = {one.name for one in self._folders("stages") if one.is_dir() and try_manifest(one)[1] is None}
        found += [spool for spool in entries(self.root / "spool") if spool.name in whole]
        return [one.relative_to(self.root).as_posix() for one in sorted(found) if self._is_free(_lock_name(one))]

    def strays(self) -> list[Path]:
        """Return what lies among stores and runs and is neither."""
        loose = [one for one in entries(self.root / "stages") if not is_folder(one)]
        known = {*self._folders("stages"), *self._folders("runs")}
        return loose + [one for one in self._places() if one not in known and not one.name.endswith(UNFINISHED)]

    def _places(self) -> list[Path]:
        """Return what lies where stores and runs do."""
        above = [*filter(is_folder, entries(self.root / "stages")), self.root / "runs"]
        return [one for folder in above for one in entries(folder)]

    def _folders(self, kind: str) -> list[Path]:
        """Return the folders of stores (also of cleared ones) or runs, and links, which count as damaged."""
        inside = [one for one in self._places() if kind in (one.parent.name, one.parents[1].name)]
        cleared = [one.with_suffix("") for one in inside if one.suffix == CLEARED and kind == "stages"]
        there = {one for one in inside if one.is_symlink() or one.is_dir()}
        return sorted(one for one in there.union(cleared) if is_name(one.name))

    def _is_free(self, lock: str) -> bool:
        if not (self.root / ".locks" / f"{lock}.lock").exists():
            return True
        with self._locked(lock, wait=False) as held:
            return held

    def _locked(self, name: str, *, wait: bool = True, shared: bool = False) -> AbstractContextManager[bool]:
        return locked(self.root / ".locks" / f"{name}.lock", wait=wait, shared=shared)

    # --- runs ---------------------------------------------------------------------------------------------------------

    def publish_run(
        self,
        name: str,
        build: Callable[[Path, str], Mapping[str, Any] | None],
        inputs: Sequence[Ref] = (),
        day: date | None = None,
    ) -> Path:
        """Publish a run below ``runs`` and return its folder, named by the time and, where it differs, a ``day``.

        ``build`` gets a folder to write into and the run's address, and returns facts for the manifest. ``inputs`` are
        the stores that the run names; `gc` keeps them, and all that they were made of.
        """
        now = datetime.now(UTC)
        begun = f"{now:%Y%m%dT%H%M%S}-{run_stem(name)}" + (f"-{day:%Y%m%d}" if day not in (None, now.date()) else "")
        for number in count(1):
            final = self.root / "runs" / (begun if number == 1 else f"{begun}-{number}")

            def write(folder: Path, uri: str = f"runs/{final.name}") -> Mapping[str, Any]:
                facts = build(folder, uri) or {}
                return {**facts, "inputs": [one.uri for one in inputs], RESTS_ON: self.manifest_hashes(inputs)}

            with refusals(self.root, "write to the archive"), self._locked(_lock_name(final), wait=False) as held:
                if held and not final.exists() and publish(final, write):
                    return final
        raise AssertionError("unreachable")

    def runs(self) -> list[Path]:
        """Return the folders of the published runs, oldest first: by the second in their names, then as written."""
        ages = dict[Path, int]()
        with refusals(self.root, "read the archive", every=True):
            for path in self._folders("runs"):
                with suppress(FileNotFoundError):
                    ages[path] = (path / MANIFEST).lstat().st_mtime_ns
        return sorted(ages, key=lambda folder: (folder.name[:SECOND], ages[folder], folder.name))

    def past_runs(self) -> Iterator[Path]:
        """Yield the published runs, newest first; those of the future are left out, with a warning."""
        for folder in reversed(self.runs()):
            if not lies_ahead(folder.name, try_manifest(folder)[0]["created"], warns=True):
                yield folder

    def run_folder(self, name: str) -> Path:
        """Return the folder of a published run by name, address or ``latest``. Raises NoRunError."""
        called = name.rstrip("/").removeprefix("runs/")
        named = (one for one in self.runs() if one.name == called)
        folder = next(self.past_runs() if called == LATEST else named, None)
        if folder is None:
            known = ", ".join(one.name for one in self.runs()[-5:])
            there = f"has no run {name!r}; its latest are {known}" if known else "has no run; survey into it first"
            raise NoRunError(f"{self.name} {there}")
        return folder

    # --- manifests and lineage ----------------------------------------------------------------------------------------

    def size_of(self, uri: str) -> int:
        """Return the present bytes of all files of a store or run, manifest included."""
        path = self.root / uri
        return _beside(path).lstat().st_size if is_cleared(path) else bytes_in(path)

    def manifests(self) -> dict[str, dict[str, Any]]:
        """Return the manifests of all stores, then runs, by address, each with its ``problem`` and ``cleared``."""
        found: dict[str, dict[str, Any]] = {}
        with refusals(self.root, "read the archive", every=True):
            for path in (*self._folders("stages"), *self._folders("runs")):
                content, problem = try_manifest(path)
                if problem is None or is_known(path):  # else another process has removed it
                    uri = path.relative_to(self.root).as_posix()
                    found[uri] = {**content, "problem": problem, "cleared": is_cleared(path)}
        return found

    def manifest_hashes(self, refs: Iterable[Ref]) -> dict[str, str]:
        """Return the digests of stores and all their inputs, and so of every byte, by address."""
        found: dict[str, str] = {}
        waiting = [ref.uri for ref in refs]
        while waiting:
            if (uri := waiting.pop()) not in found and is_known(self.root / uri):
                found[uri] = digest_of(self.root / uri) or ""
                waiting += try_manifest(self.root / uri)[0]["inputs"]
        return dict(sorted(found.items()))


Build = Callable[[Path], object]  # writes into a given folder
Manifests = Mapping[str, Mapping[str, Any]]


def ancestors(known: Manifests, uris: Iterable[str]) -> list[str]:
    """Return all inputs of these stores, direct and indirect, the nearest first, without these stores."""
    found = dict.fromkeys(uris)
    waiting = begun = list(found)
    while waiting:
        inputs = dict.fromkeys(one for uri in waiting for one in known.get(uri, {}).get("inputs", ()))
        waiting = [one for one in inputs if one not in found]
        found |= dict.fromkeys(waiting)
    return list(found)[len(begun) :]


def descendants(known: Manifests, uris: Iterable[str]) -> list[str]:
    """Return all stores that were made of these, directly or not, inputs first, without these stores."""
    begun = set(uris)
    stores = (uri for uri in known if uri.startswith("stages/") and uri not in begun)
    return inputs_first(known, (uri for uri in stores if not begun.isdisjoint(ancestors(known, [uri]))))


def inputs_first(known: Manifests, uris: Iterable[str]) -> list[str]:
    """Return these stores with inputs before the stores made of them."""
    return sorted(uris, key=lambda uri: (len(ancestors(known, [uri])), uri))


def publish(final: Path, build: Callable[[Path], Mapping[str, Any] | None]) -> bool:
    """Build a folder aside, sync it, and give it its name in one step.

    ``build`` returns facts for the manifest, or None where it has written one. Returns False where another process,
    whose lock this one did not see, has published the same name meanwhile. Raises ArchiveError: another process has
    removed the folder.
    """
    part = aside(final)
    make_folder(final.parent, _root_of(final))
    part.mkdir()
    descriptor = os.open(part, os.O_RDONLY)  # while it is open, no other folder gets its number
    try:
        facts = build(part)
        with refusals(final.parents[1], "write to", every=True):
            if facts is not None:
                write_manifest(part, facts)
            for path in (*(part / name for name in files_in(part)), *(Path(one[0]) for one in os.walk(part))):
                sync(path)
            sync(final.parents[1])  # the parent may be new: without its own name what it holds is lost
            if not os.path.samestat(os.fstat(descriptor), part.stat()):
                raise ArchiveError(f"another process has removed {part}, which was being written; run again")
            try:
                part.rename(final)
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
                return False
            sync(final.parent)
        return True
    finally:
        os.close(descriptor)
        remove(part)


def _write_beside(folder: Path, manifest: bytes) -> None:
    """Write the manifest of a store that is to be cleared."""
    make_folder(folder.parent, _root_of(folder))
    part = aside(folder)
    write_new(part, manifest)
    sync(part)
    part.replace(_beside(folder))
    sync(folder.parent)


def _lock_name(path: Path) -> str:
    """Return the name of the lock of a store, run or spool, or of what a leftover was to become."""
    kind = CAPTURED if path.parent.name == "spool" else path.parent.name
    return f"{kind}-" + re.sub(r"(\.[0-9a-f]{8})?\.part$", "", path.name)


def listed_bytes(manifest: Mapping[str, Any]) -> int:
    """Return the size of all files that a manifest lists; cleared files count too."""
    return sum(size for size, _ in manifest["files"].values())


def is_archive(address: str | Path) -> bool:
    """Return whether there is an archive to open, or a file that will be refused."""
    return (Path(address) / "stages").is_dir() or Path(address).is_file()


def run_stem(name: str) -> str:
    """Return a field's name for files and folders: A-Z, a-z, 0-9, '_' and '-', at most 60 characters.

    A name that is not of this form loses accents and other characters, and a part of its hash follows.
    """
    ascii_only = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode("ascii")
    stem = re.sub(r"[^A-Za-z0-9_-]+", "-", ascii_only).strip("-")[:60]
    if stem == name and re.search(r"-[0-9a-f]{8}$", name) is None:
        return stem
    return f"{stem[:51]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}".lstrip("-")


def lies_ahead(name: str, created: str, *, warns: bool = False) -> bool:
    """Return whether the time in a run's name or of its manifest is later than now, by a clock that is or was wrong."""
    for text in (name[:SECOND], created):
        with suppress(ValueError):
            moment = datetime.fromisoformat(text)
            if moment.replace(tzinfo=moment.tzinfo or UTC).timestamp() > time.time() + CLOCK_S:
                if warns:
                    log.warning("%s lies in the future, and is not taken as the latest run; check the clock", name)
                return True
    return False
