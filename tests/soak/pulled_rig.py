"""An emulated rig in a process of its own, with several fields to look at and cables that can be pulled.

What stands before the rig, and whether its cables are in, is told over a socket in ``folder``: :class:`RigControl`. The
mirror's port keeps its name when its cable is put in again, as a udev rule would have it: a link to the pty of now.
"""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import threading
from collections.abc import Mapping
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

from flows.cli.rig_commands import emulated_source
from flows.settings.load import load_settings
from pipeline.rig.emulator.camera_device import CameraServer
from pipeline.rig.emulator.emulated_rig import EmulatedPort, EmulatedRig, FastClock, SceneView
from pipeline.simulator.simulated import SimulatedSource
from tests.faults.nursery import ROOT

Cable = Literal["mirror", "camera"]
CONTROL, LINK = "control", "mirror"  # in the rig's folder
KEY = b"a rig of the soak"
NAP_S = 0.01


class PulledRig:
    """The rig: ``views`` are its fields by name, the first is looked at until another is asked for."""

    def __init__(self, views: Mapping[str, SimulatedSource], folder: Path, speed: float) -> None:
        self._views = {name: SceneView(source) for name, source in views.items()}
        self._folder, self._address = folder, (0, 0)
        self.rig = EmulatedRig(next(iter(views.values())), FastClock(speed))
        self.rig.camera.aside = True
        self._port: EmulatedPort | None = None
        self._server: CameraServer | None = None
        self._armed: tuple[Cable, int, int] | None = None  # with the frames to wait for, of which capture on
        self._turn, self._ended = threading.Lock(), threading.Event()
        self.plug()
        self._thread = threading.Thread(target=self._keep_looking, name="eye", daemon=True)
        self._thread.start()

    def table(self) -> dict[str, Any]:
        """The settings' table [rig]."""
        white_reference = self.rig.camera.view.source.scene.white_reference
        return {
            "port": str(self._folder / LINK),
            "host": "127.0.0.1",
            "control_port": self._address[0],
            "file_port": self._address[1],
            "pulses": self.rig.camera.wired,
            "white_reference": round(float(white_reference.mean()), 6),
            "provenance": "emulated",
        }

    def scan_pass(self, field: str) -> None:
        """Stand before another field."""
        self.rig.camera.view = self._views[field]

    def pull(self, cable: Cable, frames: int) -> None:
        """Pull a cable when the next capture of lines has run for so many frames."""
        with self._turn:
            self._armed = (cable, frames, len(self.rig.camera.captures))

    def plug(self) -> bool:
        """Put every cable in that is out, and pull none; whether one was out."""
        with self._turn:
            self._armed, out = None, self._port is None or self._server is None
            if self._port is None:
                self._port = EmulatedPort(self.rig.mirror)
                link = self._folder / LINK
                link.unlink(missing_ok=True)
                link.symlink_to(self._port.path)
            if self._server is None:
                self._server = CameraServer(self.rig.camera, self._address)
                self._address = (self._server.port, self._server.file_port)
            return out

    def close(self) -> None:
        """Let go of everything."""
        self._ended.set()
        self._thread.join()
        for cable in ("mirror", "camera"):
            self._let_go(cable)

    def _keep_looking(self) -> None:
        while not self._ended.is_set():
            self.rig.mirror.take_pulses()
            with self._turn:
                if self._armed is not None and self._far_enough(*self._armed[1:]):
                    self._let_go(self._armed[0])
                    self._armed = None
            if not self.rig.camera.keep_looking():
                self._ended.wait(NAP_S)

    def _far_enough(self, frames: int, first: int) -> bool:
        now_s = self.rig.clock.now()
        for capture in self.rig.camera.captures[first:]:
            if "references" not in capture.folder and capture.running(now_s):
                return now_s - capture.began_s >= frames * capture.period_s
        return False

    def _let_go(self, cable: Cable) -> None:
        if cable == "mirror" and self._port is not None:
            self._port.close()
            self._port = None
        elif cable == "camera" and self._server is not None:
            self._server.close()
            self._server = None


class RigControl:
    """Tells the rig of a folder what to do; for any process."""

    def __init__(self, folder: Path) -> None:
        self._address = str(folder / CONTROL)

    def ask(self, *words: object) -> Any:
        """Have a method of :class:`PulledRig` called, and give what it gives."""
        with Client(self._address, authkey=KEY) as line:
            line.send(words)
            return line.recv()


class RigProcess:
    """The rig's process, while the context lasts; it ends with the process that began it, however that ends.

    Parameters
    ----------
    fields
        Settings of what is looked at, by the fields' names.
    speed
        How many times as fast as the wall's the rig's clock goes.
    """

    def __init__(self, folder: Path, fields: Mapping[str, Mapping[str, Any]], speed: float) -> None:
        self.control = RigControl(folder)
        words = json.dumps({"folder": str(folder), "fields": fields, "speed": speed})
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.soak.pulled_rig", words],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        told = self._process.stdout.readline()
        assert told, "the emulated rig did not begin"
        self.table: dict[str, Any] = json.loads(told)

    def __enter__(self) -> RigProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate()  # closes its stdin, upon which it ends


def serve(folder: Path, fields: Mapping[str, Mapping[str, Any]], speed: float) -> None:
    """Be the rig until stdin is closed."""
    logging.disable(logging.ERROR)  # what faults do to its sockets is no news
    views = {name: emulated_source(load_settings(None, settings))[0] for name, settings in fields.items()}
    rig = PulledRig(views, folder, speed)
    with Listener(str(folder / CONTROL), authkey=KEY) as listener:
        threading.Thread(target=_answer, args=(rig, listener), daemon=True).start()
        print(json.dumps(rig.table()), flush=True)
        sys.stdin.read()
        rig.close()


def _answer(rig: PulledRig, listener: Listener) -> None:
    while True:
        try:
            line: Connection = listener.accept()
            with line:
                name, *given = line.recv()
                line.send(getattr(rig, name)(*given))
        except (OSError, EOFError):  # a process that was killed while it asked
            continue


if __name__ == "__main__":
    told = json.loads(sys.argv[1])
    serve(Path(told["folder"]), told["fields"], told["speed"])
