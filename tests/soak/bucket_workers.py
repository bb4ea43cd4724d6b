"""A survey into a bucket, by two workers that share no folder with it: from sweeps to class map.

The bucket is moto's, in a process of its own; each worker has a working copy of its own, as on another machine. The
field has 105 million px of 270 bands. Quick, a small one is surveyed by threads into a folder too, and maps compared.
"""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from storage.arrays.class_maps import load_class_map
from storage.remote.opening import open_archive
from tests.faults.fault_table import Clock, Row
from tests.faults.nursery import ROOT
from tests.object_server import BUCKET, KEYS

SIZE, QUICK_SIZE, WORKERS = "10240x10240", "1280x1024", 2
MOST_GIB, MOST_MB = 4, 2000  # of memory of each process, and of all objects
SURVEY = ("survey", "--scene", "farm", "--zoom", "never", "--scan-step", "4", "--scan-exposure-ms", "20")
EVERY_S, BEGUN_WITHIN_S = 1.0, 60.0


def rows(quick: bool) -> list[Row]:
    """Memory and bytes of the survey, and whether its map is that of threads."""
    size, address, clock = QUICK_SIZE if quick else SIZE, f"s3://{BUCKET}/field", Clock()
    with tempfile.TemporaryDirectory(prefix="bucket-") as name, ExitStack() as stack:
        folder = Path(name)
        there = stack.enter_context(cluster(folder))
        os.environ.update(there.environment)
        receipt, peaks = survey(size, address, there, "--scheduler", there.scheduler)
        archive, what = open_archive(address), f"farm of {size} px, {WORKERS} workers"
        kept, seconds = sum(archive.sizes(["stages", "runs"]).values()), clock.seconds
        memory = ", ".join(f"{peak / 2**30:.1f}" for peak in peaks)
        small = max(peaks) <= MOST_GIB * 2**30
        found = [
            Row("peak memory [GiB]", f"{what}: survey, workers", 1, f"<= {MOST_GIB} each", memory, small, seconds),
            Row("kept [MB]", "all objects", 1, f"<= {MOST_MB}", f"{kept / 1e6:.0f}", kept <= MOST_MB * 1e6, 0.0),
        ]
        if quick:
            beside, _ = survey(size, str(folder / "beside"), there)
            maps = [
                load_class_map(open_archive(out).locate(one["products"]["class_map"])).classes
                for out, one in ((address, receipt), (str(folder / "beside"), beside))
            ]
            odd = int((maps[0] != maps[1]).sum())
            found.append(Row("class map", "beside that of threads", 1, "equal", f"{odd} px differ", odd == 0, 0.0))
    return found


@dataclass(frozen=True)
class Cluster:
    """A bucket, a scheduler and its workers."""

    scheduler: str
    environment: dict[str, str]  # of a survey
    workers: list[int]  # process numbers


@contextmanager
def cluster(folder: Path) -> Iterator[Cluster]:
    """Start a bucket and workers, in processes of their own that end with the block."""
    ports = [free_port(), free_port()]
    environment = {**KEYS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{ports[0]}"}
    scheduler = f"tcp://127.0.0.1:{ports[1]}"
    with ExitStack() as stack:

        def start(*words: str, **more: str) -> int:
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            process = subprocess.Popen(
                [sys.executable, "-m", *words], cwd=ROOT, env={**os.environ, **environment, **more}, **quiet
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process.pid

        start("moto.server", "-H", "127.0.0.1", "-p", str(ports[0]))
        start("distributed.cli.dask_scheduler", "--host", scheduler, "--no-dashboard")
        asked = ("--nthreads", "1", "--memory-limit", "0", "--no-dashboard")
        workers = [
            start("distributed.cli.dask_worker", scheduler, *asked, SPECTRALZOOM_WORK=str(folder / f"worker {number}"))
            for number in range(WORKERS)
        ]
        create_bucket(environment["AWS_ENDPOINT_URL"])
        yield Cluster(scheduler, {**environment, "SPECTRALZOOM_WORK": str(folder / "survey")}, workers)


def free_port() -> int:
    """Return a port that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def create_bucket(endpoint: str) -> None:
    """Create the bucket, once its server answers."""
    import boto3
    from botocore.exceptions import ConnectionError as NoAnswer

    end = time.monotonic() + BEGUN_WITHIN_S
    known = {"aws_access_key_id": "key", "aws_secret_access_key": "secret", "region_name": "us-east-1"}
    client = boto3.client("s3", endpoint_url=endpoint, **known)
    while True:
        try:
            client.create_bucket(Bucket=BUCKET)
            return
        except NoAnswer:
            if time.monotonic() > end:
                raise
            time.sleep(0.2)


def survey(size: str, out: str, there: Cluster, *words: str) -> tuple[dict[str, Any], list[int]]:
    """Survey; return the receipt, and the peak memory [bytes] of this survey and of each worker."""
    command = [sys.executable, "-m", "flows.cli.main", *SURVEY, "--size", size, "--out", out, "--json", "--no-accuracy"]
    with subprocess.Popen([*command, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        of = [process.pid, *there.workers]
        peaks = [0] * len(of)
        while process.poll() is None:
            peaks = [max(peak, anonymous(pid)) for peak, pid in zip(peaks, of, strict=True)]
            time.sleep(EVERY_S)
        text = process.stdout.read()
    if process.returncode:
        raise RuntimeError(f"the survey ended with {process.returncode}: {text}")
    return json.loads(text), peaks


def anonymous(pid: int) -> int:
    """Return the anonymous memory [bytes] of a process and its children."""
    with suppress(OSError):
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
        children = " ".join(path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")).split()
        own = sum(int(one) for one in re.findall(r"^Anonymous: +(\d+) kB", text, re.MULTILINE))
        return 1024 * own + sum(anonymous(int(child)) for child in children)
    return 0
