"""Survey into a bucket with two workers that share no folder, from sweeps to class map.

The bucket is moto's, in a separate process; each worker has a separate working copy, as on another machine. The
field has 105 million px of 270 bands, or 1.3 million px with --quick.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from storage.remote.opening import open_archive
from tests.faults.fault_table import Row
from tests.faults.nursery import ROOT
from tests.flows.schedule.prefect_server import free_port
from tests.object_server import BUCKET, KEYS

SIZE = "10240x10240"
QUICK_SIZE = "1280x1024"
WORKERS = 2
MOST_GIB, MOST_MB = 4, 2000  # of memory of each process, and of all objects
SURVEY = ("survey", "--scene", "farm", "--zoom", "never", "--scan-step", "4", "--scan-exposure-ms", "20")
EVERY_S = 1.0
BEGUN_WITHIN_S = 60.0


def rows(quick: bool) -> list[Row]:
    """Return the rows of the memory of the survey and its workers, and of the bytes kept."""
    size = QUICK_SIZE if quick else SIZE
    address = f"s3://{BUCKET}/field"
    with tempfile.TemporaryDirectory(prefix="bucket-") as name, cluster(Path(name)) as (scheduler, workers):
        given = ("--size", size, "--out", address, "--scheduler", scheduler, "--no-accuracy")
        peaks = survey(workers, *given)
        kept = sum(open_archive(address).sizes(["stages", "runs"]).values())
    memory = ", ".join(f"{peak / 2**30:.1f}" for peak in peaks)
    small = max(peaks) <= MOST_GIB * 2**30
    how = f"farm of {size} px, {WORKERS} workers: survey, workers"
    return [
        Row("peak memory [GiB]", how, 1, f"<= {MOST_GIB} each", memory, small),
        Row("kept [MB]", "all objects", 1, f"<= {MOST_MB}", f"{kept / 1e6:.0f}", kept <= MOST_MB * 1e6),
    ]


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, list[int]]]:
    """Start a bucket and workers for the block; yield the scheduler's address and the workers' process ids."""
    ports = [free_port(), free_port()]
    os.environ.update(KEYS, AWS_ENDPOINT_URL=f"http://127.0.0.1:{ports[0]}", SPECTRALZOOM_WORK=str(folder / "survey"))
    scheduler = f"tcp://127.0.0.1:{ports[1]}"
    with ExitStack() as stack:

        def start(*words: str, **more: str) -> int:
            command = [sys.executable, "-m", *words]
            null = subprocess.DEVNULL
            process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, **more}, stdout=null, stderr=null)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process.pid

        start("moto.server", "-H", "127.0.0.1", "-p", str(ports[0]))
        start("distributed.cli.dask_scheduler", "--host", scheduler, "--no-dashboard")
        asked = ("--nthreads", "1", "--memory-limit", "0", "--no-dashboard")
        copies = [str(folder / f"worker {number}") for number in range(WORKERS)]
        workers = [start("distributed.cli.dask_worker", scheduler, *asked, SPECTRALZOOM_WORK=copy) for copy in copies]
        create_bucket()
        yield scheduler, workers


def create_bucket() -> None:
    """Create the bucket, once its server answers."""
    import boto3
    from botocore.exceptions import ConnectionError as NoAnswer

    end = time.monotonic() + BEGUN_WITHIN_S
    client = boto3.client("s3", endpoint_url=os.environ["AWS_ENDPOINT_URL"], region_name=KEYS["AWS_REGION"])
    while True:
        try:
            client.create_bucket(Bucket=BUCKET)
            return
        except NoAnswer:
            if time.monotonic() > end:
                raise
            time.sleep(0.2)


def survey(workers: list[int], *words: str) -> list[int]:
    """Run a survey; return the peak memory [bytes] of the survey and of each worker."""
    with subprocess.Popen([sys.executable, "-m", "flows.cli.main", *SURVEY, *words], cwd=ROOT) as process:
        of = [process.pid, *workers]
        peaks = [0] * len(of)
        while process.poll() is None:
            peaks = [max(peak, anonymous(pid)) for peak, pid in zip(peaks, of, strict=True)]
            time.sleep(EVERY_S)
    if process.returncode:
        raise RuntimeError(f"the survey ended with {process.returncode}")
    return peaks


def anonymous(pid: int) -> int:
    """Return the anonymous memory [bytes] of a process and its children."""
    with suppress(OSError):
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
        children = " ".join(path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")).split()
        own = sum(int(one) for one in re.findall(r"^Anonymous: +(\d+) kB", text, re.MULTILINE))
        return 1024 * own + sum(anonymous(int(child)) for child in children)
    return 0
