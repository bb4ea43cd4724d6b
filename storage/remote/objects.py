"""Read, write and list the objects of an archive in a bucket.

The environment has the access data, as for any S3 client: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION,
AWS_ENDPOINT_URL.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, SettingsError
from spectralzoom.storage.remote.all_names import PATH, all_names
from spectralzoom.storage.whole_files import open_own

AT_ONCE = 8  # transfers in parallel
NO_FILE = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR, errno.EEXIST)  # of a name in a manifest
PART_BYTES = 8 << 20  # of the parts of a large object
MOST_BYTES = 256 << 20  # of a manifest, which takes 100 bytes a file
RETRIES, RETRIED_S = 4, 2.0  # of one request, by obstore, and the time in which they begin
PAUSES_S = (0.5, 2.0, 8.0)  # before what obstore does not try again
REQUEST_S, LONGEST_S = 10, 900  # of a request
REQUEST_BYTES = 256 << 10  # for each so many bytes a request may take `REQUEST_S` more
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_PART = r"(?!\.+(?:/|$))[A-Za-z0-9_.=+-]+"
_ADDRESS = re.compile(rf"s3:/{{1,2}}({_PART})((?:/{_PART})*)/?")  # also as a path has it, which makes one slash of two
_LASTING = {  # of a bucket's answers: a part, and what a person has to do
    "NoSuchBucket": "there is no such bucket: create it, or check its name, AWS_REGION and AWS_ENDPOINT_URL",
    r"169\.254\.16": "there are no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
    "RequestTimeTooSkewed": "the clock of this machine is wrong: set it and run again",
    "HeaderMalformed|PermanentRedirect|301 Moved|redirect without LOCATION": (
        "the bucket is in another region: set AWS_REGION"
    ),
    "SignatureDoesNotMatch|InvalidAccessKeyId|ExpiredToken|AccessDenied|403 Forbidden|401 Unauth": (
        "access is denied: check the credentials and the bucket's policy (get, put, list)"
    ),
}
_PASSING = {
    "status code: (5|429)|SlowDown": "it is overloaded or has a fault: run again later",
    "error sending request|timed out|RequestTimeout|response body": (
        "it does not answer: check the network and AWS_ENDPOINT_URL"
    ),
}
CURE = "remove this store from the bucket, and push it from a machine that has it"
Answer = TypeVar("Answer")


class UnreachableError(ArchiveError):
    """A bucket that refuses, or does not answer."""


class Objects:
    """The objects below ``s3://bucket/prefix``; names are relative to it.

    A request is tried again after a lost connection, an answer cut short or damaged, overload, or a conflict of two
    writers. A small one is given up after 20 to 32 s. Every method raises UnreachableError: the bucket refuses or does
    not answer.
    """

    def __init__(self, address: str | Path) -> None:
        """Check an address, without a request to the network.

        Raises SettingsError: the address or the endpoint is not valid; ArchiveError: another setting of AWS in the
        environment is not valid, or obstore is not installed.
        """
        found = _ADDRESS.fullmatch(str(address))
        if found is None:
            raise SettingsError(
                f"{str(address)!r} is no archive on S3; expected s3://bucket/prefix in letters, digits and '_.=+-'"
            )
        self.url = f"s3://{found[1]}{found[2]}"
        self.endpoint = _endpoint()
        try:
            from obstore.exceptions import BaseError  # an extra
            from obstore.store import S3Store
        except ImportError as error:
            raise ArchiveError(
                f"{self.url}: archives on S3 need obstore ({error}); pip install 'spectralzoom[s3]'"
            ) from error
        self._errors = BaseError
        self.bad_names: list[str] = []  # of objects that the last listing left out
        self._sizes: dict[str, int] = {}
        self._address = found[1], found[2].strip("/")

        @cache
        def store(seconds: int, stalls: str) -> S3Store:
            return S3Store(
                self._address[0],
                prefix=self._address[1] or None,
                config={"endpoint": self.endpoint} if self.endpoint else {},
                client_options={
                    "allow_http": self.endpoint.startswith("http://"),
                    "connect_timeout": "5s",
                    "read_timeout": stalls,
                    "timeout": f"{seconds}s",
                },
                retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=RETRIED_S)},
            )

        self._store = store
        try:
            self._client(0)
        except BaseError as error:
            raise ArchiveError(f"{self.url} cannot be used: {_first_line(error)}") from error

    def _client(self, size: int, *, sending: bool = False) -> Any:
        """Return a client for requests of this size; a connection that stalls is given up before, unless it sends."""
        return self._store(_seconds(size), f"{_seconds(size) if sending else REQUEST_S}s")

    def read(self, name: str, check: Callable[[bytes], object] = len) -> bytes | None:
        """Return the content of a small object; None without one.

        Raises IncompleteStoreError: it is damaged, as ``check`` tells by a ValueError.
        """

        def read() -> bytes:
            answer = self._client(self._sizes.get(name, 0)).get(name)
            try:
                if answer.meta["size"] > MOST_BYTES:
                    raise ValueError(f"it has {answer.meta['size']} bytes")
                content = bytes(answer.bytes())
                check(content)
            except ValueError as error:
                raise IncompleteStoreError(f"{self.url}/{name} is damaged: {error}; {CURE}") from error
            return content

        try:
            return self._ask(read, self._sizes.get(name, 0))
        except FileNotFoundError:
            return None

    def create(self, name: str, content: bytes) -> bytes:
        """Write a small object unless its name exists (``If-None-Match: *``); return the content that is there then."""
        from obstore.exceptions import AlreadyExistsError  # an extra

        def write() -> bytes:
            try:
                self._client(len(content), sending=True).put(name, content, mode="create", use_multipart=False)
                return content
            except AlreadyExistsError as error:  # or two writers at the same time, or one whose answer was lost
                try:
                    return bytes(self._client(len(content)).get(name).bytes())
                except FileNotFoundError:
                    raise error from None

        return self._ask(write, len(content))

    def write(self, name: str, source: Path, sha256: str) -> None:
        """Write an object from a file of an archive, replacing any old one; readers never see a part of it.

        Raises IncompleteStoreError: what was sent has another SHA-256.
        """
        size = source.stat().st_size
        store = self._client(min(size, PART_BYTES), sending=True)

        def write() -> str:
            digest = hashlib.sha256()

            def blocks() -> Iterator[bytes]:
                with open_own(source) as file:
                    while block := file.read(PART_BYTES):
                        digest.update(block)
                        yield block

            content = blocks() if size > PART_BYTES else b"".join(blocks())
            store.put(name, content, chunk_size=PART_BYTES, max_concurrency=2)
            return digest.hexdigest()

        if self._ask(write, size) != sha256:
            raise IncompleteStoreError(f"{source} has changed since it was published (its SHA-256 differs)")

    def fetch(self, name: str, path: Path, size: int, sha256: str) -> None:
        """Write an object into a new file. Raises IncompleteStoreError: it is missing, or has other content."""

        def fetch() -> None:
            digest = hashlib.sha256()
            path.unlink(missing_ok=True)
            with open_own(path, "xb") as file:
                answer = self._client(size).get(name)
                for block in answer.stream(PART_BYTES) if answer.meta["size"] == size else ():
                    digest.update(block)
                    file.write(block)
            if digest.hexdigest() != sha256:
                raise IncompleteStoreError(
                    f"{self.url}/{name} has changed since it was published (its size or SHA-256 differs); {CURE}"
                )

        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._ask(fetch, size)
        except FileNotFoundError:
            raise IncompleteStoreError(f"{self.url}/{name} is missing; {CURE}") from None
        except OSError as error:
            if error.errno not in NO_FILE:
                raise
            raise IncompleteStoreError(f"{self.url}/{name} can be no file: {error.strerror}; {CURE}") from error

    def listing(self) -> set[str]:
        """Return the names of all objects; `bad_names` gets those that are no path, which obstore refuses to list."""
        bucket, prefix = self._address

        def listed() -> dict[str, int]:
            return {one["path"]: one["size"] for batch in self._client(0).list(chunk_size=1000) for one in batch}

        try:
            self._sizes = self._ask(listed)
        except IncompleteStoreError as error:
            try:
                names = all_names(bucket, f"{prefix}/" if prefix else "", self.endpoint, REQUEST_S)
            except KeyError:
                raise error from None
            except OSError as refused:
                raise self.explain(refused) from refused
            self._sizes = dict.fromkeys(names, 0)
            self.bad_names = [name for name in names if name and not PATH.fullmatch(name.removesuffix("/"))]
        return set(self._sizes)

    def explain(self, error: BaseException) -> UnreachableError:
        """Return the error of an answer of the bucket, with advice."""
        advice = _advice(error, _LASTING | _PASSING) or _first_line(error)
        return UnreachableError(f"{self.url}{f' at {self.endpoint}' if self.endpoint else ''}: {advice}")

    def _ask(self, work: Callable[[], Answer], size: int = 0) -> Answer:
        """Do ``work`` on so many bytes, again after a failure that may pass, in about twice the time of a request.

        Raises FileNotFoundError: there is no such object; IncompleteStoreError: its name or content is not valid.
        """
        from obstore.exceptions import InvalidPathError

        end = time.monotonic() + 2 * _seconds(size)
        for pause_s in (*PAUSES_S, None):
            try:
                return work()
            except InvalidPathError as error:
                raise IncompleteStoreError(f"{self.url} has an object of a bad name: {_first_line(error)}") from error
            except (self._errors, FileNotFoundError, IncompleteStoreError) as error:
                is_lasting = _advice(error, _LASTING) is not None
                if isinstance(error, FileNotFoundError) and not is_lasting:
                    raise
                if pause_s is None or is_lasting or time.monotonic() + pause_s > end:
                    if isinstance(error, IncompleteStoreError):
                        raise
                    raise self.explain(error) from error
                time.sleep(pause_s)
        raise AssertionError("unreachable")


def _seconds(size: int) -> int:
    """Return the longest time of a request with so many bytes, at most a quarter of an hour."""
    return min(REQUEST_S * (1 + max(size, 0) // REQUEST_BYTES), LONGEST_S)


def _endpoint() -> str:
    """Return the server that the environment names, or nothing for AWS itself."""
    text = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
    found = re.match(r"(https?)://(\[[\da-f:]+\]|[^/:\s]+)(:\d+)?(/|$)", text)
    if text and found is None:
        raise SettingsError(f"AWS_ENDPOINT_URL={text!r} is no address; expected https://HOST, or http://127.0.0.1:PORT")
    allowed = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes")
    if found is not None and found[1] == "http" and found[2] not in LOOPBACK and not allowed:
        raise SettingsError(
            f"AWS_ENDPOINT_URL={text}: over plain http others on the way can read and change the data; use https, or "
            "set AWS_ALLOW_HTTP=true"
        )
    return text


def _advice(error: BaseException, known: Mapping[str, str]) -> str | None:
    return next((advice for signs, advice in known.items() if re.search(signs, str(error))), None)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def some_at_a_time(work: Callable[[str], Answer], names: Iterable[str]) -> list[Answer]:
    """Run ``work`` on a few names at a time; return the answers, or raise the first error."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(work, names))  # which, after an error, cancels what has not begun
