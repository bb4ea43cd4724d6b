"""Read, write and list the objects of an archive in a bucket.

The environment has the access data, as for any S3 client: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION,
AWS_ENDPOINT_URL.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, SettingsError

if TYPE_CHECKING:
    from obstore.store import S3Store

AT_ONCE = 8  # transfers in parallel
PART_BYTES = 8 << 20  # of the parts of a large object
RETRIES = 6  # of one request, in about ten seconds
LOOPBACK = ("127.0.0.1", "localhost", "::1")
_ADDRESS = re.compile(r"s3:/{1,2}([^/]*)/*(.*)")  # also as a path has it, which makes one slash of two
_PART = re.compile(r"[A-Za-z0-9_.=+-]+")
_MEANINGS = (  # parts of a store's answers: their meaning and what to do
    (("NoSuchBucket",), "there is no such bucket: create it, or check its name, AWS_REGION and AWS_ENDPOINT_URL"),
    (("169.254.16",), "there are no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"),
    (("RequestTimeTooSkewed",), "the clock of this machine is wrong: set it and run again"),
    (("status code: 5", "status code: 429"), "it is overloaded or has a fault: run again later"),
    (
        ("HeaderMalformed", "PermanentRedirect", "301 Moved", "redirect without LOCATION"),
        "the bucket is in another region: set AWS_REGION",
    ),
    (
        ("SignatureDoesNotMatch", "InvalidAccessKeyId", "ExpiredToken", "AccessDenied", "403 Forbidden", "401 Unauth"),
        "access is denied: check the credentials and the bucket's policy (get, put, list, delete)",
    ),
    (
        ("error sending request", "timed out", "response body error"),
        "it does not answer: check the network and AWS_ENDPOINT_URL",
    ),
)


class UnreachableError(ArchiveError):
    """A bucket that refuses, or does not answer."""


@dataclass(frozen=True)
class ObjectPlace:
    """An archive's place in a bucket. ``endpoint`` is None for AWS itself."""

    bucket: str
    prefix: str
    endpoint: str | None = None

    @property
    def url(self) -> str:
        """The address that the user gives."""
        return f"s3://{self.bucket}/{self.prefix}" if self.prefix else f"s3://{self.bucket}"


def parse_place(text: str | Path) -> ObjectPlace:
    """Read ``s3://bucket/prefix``; the endpoint comes from the environment.

    Raises SettingsError: the address or the endpoint is not valid.
    """
    found = _ADDRESS.fullmatch(str(text))
    bucket, prefix = ("", "") if found is None else (found[1], found[2].strip("/"))
    parts = prefix.split("/") if prefix else []
    if not all(_PART.fullmatch(part) and part.strip(".") for part in (bucket, *parts)):
        raise SettingsError(
            f"{str(text)!r} is no archive on S3; expected s3://bucket/prefix in letters, digits and '_.=+-'"
        )
    return ObjectPlace(bucket, prefix, _endpoint())


def _endpoint() -> str | None:
    text = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    if not text:
        return None
    try:
        parts = urlsplit(text)
    except ValueError:
        parts = urlsplit("")
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise SettingsError(f"AWS_ENDPOINT_URL={text!r} is no address; expected https://HOST, or http://127.0.0.1:PORT")
    allowed = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes")
    if parts.scheme == "http" and parts.hostname not in LOOPBACK and not allowed:
        raise SettingsError(
            f"AWS_ENDPOINT_URL={text}: over plain http others on the way can read and change the data; use https, or "
            "set AWS_ALLOW_HTTP=true"
        )
    return text


def connect(place: ObjectPlace) -> S3Store:
    """Return a store for a place, without a request to the network.

    Raises ArchiveError: a setting of AWS in the environment is not valid, or obstore is not installed.
    """
    try:
        from obstore.exceptions import BaseError  # an extra
        from obstore.store import S3Store
    except ImportError as error:
        raise ArchiveError(
            f"{place.url}: archives on S3 need obstore ({error}); pip install 'spectralzoom[s3]'"
        ) from error
    http = place.endpoint is not None and place.endpoint.startswith("http://")
    try:
        return S3Store(
            place.bucket,
            prefix=place.prefix or None,
            config={} if place.endpoint is None else {"endpoint": place.endpoint},
            client_options={"allow_http": http, "connect_timeout": "5s", "read_timeout": "30s", "timeout": "15min"},
            retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(minutes=2)},
        )
    except BaseError as error:
        raise ArchiveError(f"{place.url} cannot be used: {_first_line(error)}") from error


@contextmanager
def answers_of(place: ObjectPlace) -> Iterator[None]:
    """Turn the errors of a store into an UnreachableError with advice."""
    from obstore.exceptions import BaseError

    try:
        yield
    except (BaseError, FileNotFoundError, PermissionError) as error:
        if isinstance(error, FileNotFoundError) and "NoSuchBucket" not in str(error):
            raise
        known = (advice for signs, advice in _MEANINGS if any(sign in str(error) for sign in signs))
        at = "" if place.endpoint is None else f" at {place.endpoint}"
        raise UnreachableError(f"{place.url}{at}: {next(known, _first_line(error))}") from error


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


class Objects:
    """The objects of one place; names are relative to it.

    Every method raises UnreachableError where the bucket refuses or does not answer.
    """

    def __init__(self, place: ObjectPlace) -> None:
        self.place = place
        self.store = connect(place)

    def read(self, name: str) -> bytes | None:
        """Return the content of a small object; None without one."""
        with answers_of(self.place):
            try:
                return bytes(self.store.get(name).bytes())
            except FileNotFoundError as error:
                if "NoSuchBucket" in str(error):
                    raise
                return None

    def create(self, name: str, content: bytes) -> bool:
        """Write an object unless its name exists (``If-None-Match: *``); return whether it was written."""
        from obstore.exceptions import AlreadyExistsError  # an extra

        with answers_of(self.place):
            try:
                self.store.put(name, content, mode="create", use_multipart=False)
            except AlreadyExistsError:
                return False
        return True

    def write(self, name: str, source: Path | bytes) -> None:
        """Write an object from a file or bytes, replacing any old one; readers never see a part of it."""
        with answers_of(self.place):
            self.store.put(name, source, chunk_size=PART_BYTES, max_concurrency=2)

    def fetch(self, name: str, path: Path, sha256: str) -> None:
        """Write an object into a new file. Raises IncompleteStoreError: it is missing, or has another SHA-256."""
        digest = hashlib.sha256()
        path.parent.mkdir(parents=True, exist_ok=True)
        advice = "push it again from a machine that has it"
        try:
            with path.open("wb") as file, answers_of(self.place):
                for block in self.store.get(name).stream(PART_BYTES):
                    digest.update(block)
                    file.write(block)
        except FileNotFoundError:
            raise IncompleteStoreError(f"{self.place.url}/{name} is missing; {advice}") from None
        if digest.hexdigest() != sha256:
            raise IncompleteStoreError(
                f"{self.place.url}/{name} has changed since it was published (its SHA-256 differs); {advice}"
            )

    def listing(self) -> set[str]:
        """Return the names of all objects."""
        with answers_of(self.place):
            return {one["path"] for batch in self.store.list(chunk_size=1000) for one in batch}

    def remove(self, name: str) -> None:
        """Remove one object."""
        with answers_of(self.place):
            self.store.delete(name)


def some_at_a_time(work: Callable[[str], None], names: Iterable[str]) -> None:
    """Run ``work`` on a few names at a time; raise the first error."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(work, names))  # which, after an error, cancels what has not begun
