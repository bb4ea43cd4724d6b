"""Run an S3 server on loopback: moto, in a thread of this process, with one bucket.

It serves S3 only: moto's server for all services selects a service at each request, which took half of its time.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from tempfile import NamedTemporaryFile
from threading import Thread
from typing import Any

import pytest

BUCKET = "surveys"
KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_REGION": "us-east-1"}
_numbers = count()


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """Yield the endpoint of a server with an empty bucket; skip if moto or obstore is not installed."""
    pytest.importorskip("obstore", reason="obstore is not installed (extra s3)")
    moto = pytest.importorskip("moto.moto_server.werkzeug_app", reason="moto[s3] or flask is not installed (extra dev)")
    import boto3
    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = make_server("127.0.0.1", 0, moto.create_backend_app("s3"), True, request_handler=moto.MotoRequestHandler)
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    url = f"http://127.0.0.1:{server.server_port}"
    client = boto3.client(
        "s3", endpoint_url=url, aws_access_key_id="key", aws_secret_access_key="secret", region_name="us-east-1"
    )
    client.create_bucket(Bucket=BUCKET)
    client.close()
    yield url
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def bucket(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the address of a new archive in the bucket, and set the environment for it; try again at once."""
    monkeypatch.setattr("spectralzoom.storage.remote.objects.PAUSES_S", (0.0, 0.0, 0.0))
    for name in ("AWS_SESSION_TOKEN", "AWS_PROFILE", "AWS_DEFAULT_REGION", "AWS_ENDPOINT_URL_S3"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {**KEYS, "AWS_ENDPOINT_URL": s3_server}.items():
        monkeypatch.setenv(name, value)
    return f"s3://{BUCKET}/archive-{next(_numbers)}"


def overwrite(objects: Any, name: str, content: bytes) -> None:
    """Replace an object of a bucket."""
    with NamedTemporaryFile() as file:
        Path(file.name).write_bytes(content)
        objects.write(name, Path(file.name), hashlib.sha256(content).hexdigest())
