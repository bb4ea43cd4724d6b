"""What Prefect costs a served field: processor time of `serve` at rest, and of a scheduled run over a plain survey."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from measure import Row
from PIL import Image

from models.weights.files import save_weights
from tests.conftest import CLASSES, RGB_NM, patchy_scene, random_weights
from tests.flows.schedule.prefect_server import free_port

ROOT = Path(__file__).resolve().parents[2]
SETTLES_S, REST_S = 30.0, 60.0
WAIT_S = 300.0
SCENE = 'source = "sim"\nscene = "scene.png"\nweights = "weights.safetensors"\n'
SETTINGS = f'{SCENE}budget = 0.8\neffects = "none"\ncontrols = false\n'
TICKS = os.sysconf("SC_CLK_TCK")


def rows() -> list[Row]:
    """Serve one field, leave it alone, ask for runs of it, and survey the same by hand."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = small_field(folder)
        idle_s, run_s = _served(folder, file)
        uniform_s = _plain(folder, file)
    load = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    return [
        Row("serve at rest, server and runner", f"{idle_s:.1f} s a minute", "", None, f"processor time; {load}"),
        Row("a scheduled run, all of it", f"{run_s:.1f} s", "", None, f"of its process, and what serve adds; {load}"),
        Row("the same by survey --engine plain", f"{uniform_s:.1f} s", "", None, f"of its process; {load}"),
    ]


def small_field(folder: Path) -> Path:
    """Write a small picture, small weights and the settings of a field, and return its file."""
    values, _ = patchy_scene((48, 64), 3, seed=1)
    Image.fromarray(values.astype(np.uint8)).save(folder / "scene.png")
    save_weights(random_weights(RGB_NM, CLASSES), folder / "weights.safetensors")
    file = folder / "hourly.toml"
    file.write_text(SETTINGS)
    return file


def _served(folder: Path, file: Path) -> tuple[float, float]:
    """Processor seconds of serve in a minute of rest, and of one more run."""
    port, words = free_port(), [sys.executable, "-m", "flows.cli.main", "serve", str(file), "--every", "365d"]
    words += ["--out", str(folder / "archive"), "--port", str(port)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, cwd=ROOT, env=environment) as process:
        try:
            api, password = f"http://127.0.0.1:{port}/api", _wait_for(folder / "archive" / ".prefect" / "password")
            deployment = _asked(api, password, "GET", "/deployments/name/survey/hourly")
            _run(api, password, deployment["id"])  # the first compiles what the second finds
            time.sleep(SETTLES_S)
            before = _spent(process.pid)
            time.sleep(REST_S)
            idle_s = (_spent(process.pid) - before) * 60 / REST_S
            before, began = _spent(process.pid), time.monotonic()
            _run(api, password, deployment["id"])
            run_s = _spent(process.pid) - before - idle_s * (time.monotonic() - began) / 60
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(60)
    return idle_s, run_s


def _wait_for(path: Path) -> str:
    end = time.monotonic() + WAIT_S
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.2)
    return path.read_text().strip()


def _asked(api: str, password: str, method: str, path: str, **content: object) -> dict[str, object]:
    """Ask the server, again until it answers well."""
    import httpx

    user, _, word = password.partition(":")
    end = time.monotonic() + WAIT_S
    while True:
        try:
            answer = httpx.request(method, api + path, json=content or None, auth=(user, word), timeout=30.0)
            answer.raise_for_status()
            found: dict[str, object] = answer.json()
            return found
        except httpx.HTTPError:
            if time.monotonic() > end:
                raise
            time.sleep(0.5)


def _run(api: str, password: str, deployment: object) -> None:
    """Have a deployment run once, until its process has ended."""
    made = _asked(api, password, "POST", f"/deployments/{deployment}/create_flow_run", state={"type": "SCHEDULED"})
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        found = _asked(api, password, "GET", f"/flow_runs/{made['id']}")
        if found["state_type"] in ("COMPLETED", "FAILED", "CRASHED", "CANCELLED"):
            if found["state_type"] != "COMPLETED":
                raise RuntimeError(f"the run ended {found['state_type']}")
            time.sleep(3.0)  # its process goes
            return
        time.sleep(0.5)
    raise RuntimeError("the run has not ended")


def _spent(pid: int) -> float:
    """Processor seconds of a process, and of those of its children that have ended (Linux)."""
    parts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, parts[11:15])) / TICKS


def _plain(folder: Path, file: Path) -> float:
    """Processor seconds of a survey by hand, the second of two."""
    words = [sys.executable, "-m", "flows.cli.main", "survey", str(file), "--engine", "plain"]
    for number in range(2):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [*words, "--out", str(folder / f"plain-{number}")], cwd=ROOT, check=True, stderr=subprocess.DEVNULL
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
