"""List the names of objects that obstore refuses to list, since one of them is no path: signed requests of our own."""

from __future__ import annotations

import hashlib
import hmac
import html
import os
import re
from datetime import UTC, datetime
from urllib.parse import quote, unquote_plus, urlencode, urlsplit
from urllib.request import Request, urlopen

PATH = re.compile(r"(?!.*(^|/)\.{0,2}(/|$))[^\x00-\x1f\x7f]+")  # the names that obstore takes
_KEY, _MORE = re.compile(r"<Key>(.*?)</Key>"), re.compile(r"<NextContinuationToken>(.*?)</NextContinuationToken>")


def all_names(bucket: str, prefix: str, endpoint: str, seconds: float) -> list[str]:
    """Return the names of all objects below a prefix, relative to it, whatever their letters.

    Raises OSError: the server refuses or does not answer; KeyError: the environment has no credentials.
    """
    found: list[str] = []
    query = {"encoding-type": "url", "list-type": "2", "prefix": prefix}
    while True:
        with urlopen(signed(bucket, query, endpoint, datetime.now(UTC)), timeout=seconds) as answer:
            text = answer.read().decode()
        found += [unquote_plus(html.unescape(name))[len(prefix) :] for name in _KEY.findall(text)]
        if (more := _MORE.search(text)) is None:
            return found
        query["continuation-token"] = html.unescape(more[1])


def signed(bucket: str, query: dict[str, str], endpoint: str, now: datetime) -> Request:
    """Return a GET request for a bucket, with the credentials of the environment (AWS's signature, version 4)."""
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
    base = (endpoint or f"https://s3.{region}.amazonaws.com").rstrip("/")
    words = urlencode(sorted(query.items()), quote_via=quote, safe="-_.~")
    headers = {
        "host": urlsplit(base).netloc,
        "x-amz-content-sha256": hashlib.sha256(b"").hexdigest(),
        "x-amz-date": f"{now:%Y%m%dT%H%M%SZ}",
    }
    if token := os.environ.get("AWS_SESSION_TOKEN"):
        headers["x-amz-security-token"] = token
    names, path = ";".join(headers), f"{urlsplit(base).path}/{bucket}"
    lines = [f"{name}:{value}" for name, value in headers.items()]
    request = "\n".join(["GET", path, words, *lines, "", names, headers["x-amz-content-sha256"]])
    scope = f"{now:%Y%m%d}/{region}/s3/aws4_request"
    text = "\n".join(["AWS4-HMAC-SHA256", headers["x-amz-date"], scope, hashlib.sha256(request.encode()).hexdigest()])
    key = f"AWS4{os.environ['AWS_SECRET_ACCESS_KEY']}".encode()
    for part in (*scope.split("/"), text):
        key = hmac.digest(key, part.encode(), "sha256")
    credential = f"{os.environ['AWS_ACCESS_KEY_ID']}/{scope}"
    headers["Authorization"] = f"AWS4-HMAC-SHA256 Credential={credential}, SignedHeaders={names}, Signature={key.hex()}"
    return Request(f"{base}/{bucket}?{words}", headers=headers)
