"""Where an archive on S3 lies: its address, how its bucket is reached, its working copy here, and refusals in words.

How it is reached stands in the environment, as for any S3 client: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION,
AWS_ENDPOINT_URL. SPECTRALZOOM_WORK names the folder of working copies.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from pipeline.errors import ArchiveError, SettingsError

if TYPE_CHECKING:
    from obstore.store import BackoffConfig, ClientConfig, RetryConfig, S3Config, S3Store

RETRIES = 6  # of one request, after waits that grow up to threefold: some ten seconds in all
BACKOFF: BackoffConfig = {"init_backoff": timedelta(seconds=0.5), "max_backoff": timedelta(seconds=8), "base": 3}
LOOPBACK = ("127.0.0.1", "localhost", "::1")
_ADDRESS = re.compile(r"s3:/+([^/]*)/*(.*)")  # also as a path has it, which makes one slash of two
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_PART = re.compile(r"[A-Za-z0-9_.=+-]+")
_MEANINGS = {  # what a store's answer begins with or holds -> what it means and what to do
    "NoSuchBucket": "there is no such bucket: create it, or check its name, AWS_REGION and AWS_ENDPOINT_URL",
    "169.254.16": "there are no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
    "SignatureDoesNotMatch": "the credentials are refused: check AWS_SECRET_ACCESS_KEY",
    "InvalidAccessKeyId": "the credentials are refused: check AWS_ACCESS_KEY_ID",
    "ExpiredToken": "the credentials have expired: renew them, and AWS_SESSION_TOKEN",
    "AuthorizationHeaderMalformed": "the bucket is in another region: set AWS_REGION",
    "PermanentRedirect": "the bucket is in another region: set AWS_REGION",
    "301 Moved": "the bucket is in another region: set AWS_REGION",
    "redirect without LOCATION": "the bucket is in another region: set AWS_REGION",
    "AccessDenied": "access is denied: check the credentials and the bucket's policy (get, put, list, delete)",
    "403 Forbidden": "access is denied: check the credentials and the bucket's policy (get, put, list, delete)",
    "401 Unauthorized": "access is denied: check the credentials",
    "error sending request": "it cannot be reached: check the network and AWS_ENDPOINT_URL",
    "timed out": "it does not answer in time: check the network and AWS_ENDPOINT_URL",
    "response body error": "its answer was broken off: check the network",
    "501 Not Implemented": "it lacks what an archive needs (conditional puts, listing): use another store",
    "status code: 5": "it has trouble of its own, or is asked too much: run again later",
}
_PASSING = ("error sending request", "timed out", "response body error", "status code: 5")


class UnreachableError(ArchiveError):
    """A bucket that refuses, or does not answer. ``passing``: it may answer later, with nothing changed here."""

    def __init__(self, message: str, *, passing: bool = False) -> None:
        super().__init__(message)
        self.passing = passing


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

    def working_copy(self) -> Path:
        """Folder on this machine in which the archive is worked on; its last part is what the archive is called."""
        base = os.environ.get("SPECTRALZOOM_WORK")
        if base is None:
            base = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
            base = f"{base}/spectralzoom/s3"
        mark = hashlib.sha256(f"{self.endpoint or ''} {self.url}".encode()).hexdigest()[:12]
        return Path(base).expanduser().absolute() / mark / (self.prefix.rpartition("/")[2] or self.bucket)


def is_remote(root: str | Path) -> bool:
    """Whether an archive's name is an address on S3, and no folder's (SettingsError: it is one of another kind)."""
    found = _ADDRESS.fullmatch(str(root)) is not None
    if "://" in str(root) and not found:
        raise SettingsError(f"{str(root)!r} is no place for an archive; expected a folder, or s3://bucket/prefix")
    return found


def parse_place(text: str | Path) -> ObjectPlace:
    """Read ``s3://bucket/prefix``; the endpoint comes from the environment.

    Raises
    ------
    SettingsError : it is no such address, or the endpoint is none that can be used.
    """
    found = _ADDRESS.fullmatch(str(text))
    bucket, prefix = ("", "") if found is None else (found[1], found[2].strip("/"))
    parts = prefix.split("/") if prefix else []
    if not _BUCKET.fullmatch(bucket) or not all(_PART.fullmatch(part) and part.strip(".") for part in parts):
        raise SettingsError(
            f"{str(text)!r} is no archive on S3; expected s3://bucket/prefix, the bucket in small letters, digits, '-' "
            "and '.', the prefix in letters, digits and '_.=+-'"
        )
    if "stages" in parts:
        raise SettingsError(f"{str(text)!r} lies in an archive's folder stages, where nothing else belongs")
    return ObjectPlace(bucket, prefix, _endpoint())


def _endpoint() -> str | None:
    text = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    if not text:
        return None
    try:
        parts = urlsplit(text)
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port or 1) > 0
    except ValueError:
        good = False
    if not good:
        raise SettingsError(f"AWS_ENDPOINT_URL={text!r} is no address; expected https://HOST, or http://127.0.0.1:PORT")
    allowed = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes")
    if parts.scheme == "http" and parts.hostname not in LOOPBACK and not allowed:
        raise SettingsError(
            f"AWS_ENDPOINT_URL={text}: over plain http anybody on the way can read and change the data; use https, or "
            "set AWS_ALLOW_HTTP=true"
        )
    return text


def need_obstore(name: str | Path) -> None:
    """Refuse an archive on S3 (ArchiveError) where the package that reaches it is not installed."""
    try:
        import obstore.store  # noqa: F401
    except ImportError as error:
        raise ArchiveError(f"{name}: archives on S3 need obstore ({error}); pip install 'spectralzoom[s3]'") from error


def connect(place: ObjectPlace, inside: str = "") -> S3Store:
    """Open a place, or a folder in it, as a store whose names begin there; nothing is asked of the network yet.

    Raises
    ------
    ArchiveError : a setting of AWS in the environment is none.
    """
    from obstore.exceptions import BaseError
    from obstore.store import S3Store

    http = place.endpoint is not None and place.endpoint.startswith("http://")
    client: ClientConfig = {"allow_http": http, "connect_timeout": "5s", "read_timeout": "30s", "timeout": "15min"}
    retry: RetryConfig = {"max_retries": RETRIES, "retry_timeout": timedelta(minutes=2), "backoff": BACKOFF}
    prefix = f"{place.prefix}/{inside}".strip("/")
    config: S3Config = {} if place.endpoint is None else {"endpoint": place.endpoint}
    try:
        return S3Store(place.bucket, prefix=prefix or None, config=config, client_options=client, retry_config=retry)
    except BaseError as error:
        raise ArchiveError(f"{place.url} cannot be used: {_first_line(error)}") from error


@contextmanager
def answers_of(place: ObjectPlace) -> Iterator[None]:
    """Turn what a store answers, or that it does not answer, into an UnreachableError that says what to do."""
    from obstore.exceptions import BaseError

    try:
        yield
    except (BaseError, FileNotFoundError, PermissionError) as error:
        if isinstance(error, FileNotFoundError) and "NoSuchBucket" not in str(error):
            raise
        text = str(error)
        meaning = next((words for sign, words in _MEANINGS.items() if sign in text), _first_line(error))
        if "invalid path" in text:
            meaning += "; take it out of the bucket: nothing in an archive is called so"
        at = "" if place.endpoint is None else f" at {place.endpoint}"
        passing = any(sign in text for sign in _PASSING) and "501 Not" not in text
        raise UnreachableError(f"{place.url}{at}: {meaning}", passing=passing) from error


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
