"""The verbs `rig check` and `rig emulate`: a table of what was asked and came; a rig behind a pty and sockets."""

from __future__ import annotations

import json
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import cast

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.settings.load import load_settings
from flows.settings.survey_settings import BUILT_IN_SCENES, Settings
from flows.simulate.command import open_simulation
from flows.tasks.stages.effects import choose_effects, source_with
from flows.terminal.processes import DONE, FAILED, PARTLY
from flows.terminal.progress import on_stdout, print_json
from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import STRAIGHT
from pipeline.geometry.scan import CostModel
from pipeline.rig.device_settings import CameraLimits, SurveyRig
from pipeline.rig.devices import SYSTEM_CLOCK
from pipeline.rig.emulator.emulated_rig import EmulatedRig, FastClock, ServedRig
from pipeline.rig.opening import open_camera_driver, open_devices, open_mirror_driver
from pipeline.rig.rig_check import TRIGGERS, CheckRow, Device, check_camera, check_mirror, check_triggers, works
from pipeline.simulator.simulated import SimulatedSource

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


@dataclass(frozen=True)
class CheckRequest:
    """Which devices to check; None leaves one out."""

    rig: SurveyRig
    mirror: bool = True
    camera: bool = True
    move: bool = False
    vector_pairs: int = CostModel.vector_pairs
    exposed: LineCamera = field(default_factory=LineCamera)  # times of a capture whose edges are counted


def check_request(settings: Path | None, port: str | None, camera: str | None, *, move: bool = False) -> CheckRequest:
    """What to check: both devices of the settings, or those that are named (SettingsError: they cannot be used)."""
    wanted = load_settings(settings)
    rig = wanted.rig
    if port is not None:
        rig = replace(rig, port=port)
    if camera is not None:
        rig = _at(rig, camera)
    both = settings is not None or port is camera is None
    mirror_asked, camera_asked = both or port is not None, both or camera is not None
    return CheckRequest(rig, mirror_asked, camera_asked, move, wanted.cost.vector_pairs, wanted.camera)


def run_check(request: CheckRequest, console: Console, *, as_json: bool = False) -> int:
    """Check the devices, with a table on stdout; 0 where nothing failed, 3 where one of two works, 1 otherwise."""
    rig = replace(request.rig, park_at_close=False)  # the square ends at 0; 0 by itself
    limits = CameraLimits(most_rate_hz=request.exposed.max_rate_hz)
    asked: dict[Device, bool] = {"mirror": request.mirror, "camera": request.camera}
    rows: list[CheckRow] = []
    if request.mirror:
        with console.status(f"asking the mirror at {rig.port}"):
            open_mirror = partial(open_mirror_driver, rig, request.vector_pairs)
            rows += check_mirror(open_mirror, SYSTEM_CLOCK, move=request.move)
    if request.camera:
        with console.status(f"asking the camera at {rig.host}"):
            rows += check_camera(partial(open_camera_driver, rig, limits))
    why_not = _why_no_triggers(request, rows)
    if request.mirror and why_not:
        rows.append(CheckRow("mirror", TRIGGERS, f'not tried {why_not}; pulses = "{rig.pulses}" is taken on trust'))
    elif request.mirror:
        with console.status("asking what steps a path"):
            connect = partial(open_devices, rig, request.vector_pairs, limits)
            rows += check_triggers(connect, SYSTEM_CLOCK, rig.pulses, request.exposed)
    good = [works(rows, device) for device, is_asked in asked.items() if is_asked]
    code = DONE if all(good) else PARTLY if any(good) else FAILED
    if not as_json:
        _print(rows, on_stdout())
        return code
    print_json(
        {
            "port": rig.port if request.mirror else None,
            "camera": f"{rig.host}:{rig.control_port}" if request.camera else None,
            "move": request.move,
            "rows": [row.record() for row in rows],
            "failed": sum(row.verdict == "fail" for row in rows),
            "warned": sum(row.verdict == "warn" for row in rows),
            "exit_code": code,
        }
    )
    return code


def _why_no_triggers(request: CheckRequest, rows: Sequence[CheckRow]) -> str:
    """Return why no path is played; "" where one is."""
    if not request.move:
        return "without --move"
    if not request.camera:
        return "without a camera"
    return "" if all(row.verdict == "ok" for row in rows) else "as not all of the above is in order"


def _print(rows: Sequence[CheckRow], console: Console) -> None:
    table = Table("device", "asked", "came", "", box=SIMPLE_HEAD)
    for row in rows:
        verdict = f"[{_COLOURS[row.verdict]}]{row.verdict}[/]"
        table.add_row(row.device, escape(row.asked), escape(row.came), verdict)
    console.print(table)
    mend = [row for row in rows if row.mend]
    for row in mend:
        say = f"[{_COLOURS[row.verdict]}]{row.verdict}[/] {row.device}, {escape(row.asked)}: {escape(row.mend)}"
        console.print(say, soft_wrap=True)
    if not mend:
        console.print("nothing to mend")


def _at(rig: SurveyRig, camera: str) -> SurveyRig:
    """The rig with the camera at HOST, HOST:PORT or HOST:PORT:FILE_PORT."""
    host, *ports = camera.split(":")
    if not host or len(ports) > 2 or not all(port.isdecimal() and 0 < int(port) < 65536 for port in ports):
        raise SettingsError(f"--camera expects HOST, HOST:PORT or HOST:PORT:FILE_PORT, got {camera!r}")
    control, files = (*map(int, ports), *(rig.control_port, rig.file_port)[len(ports) :])
    return replace(rig, host=host, control_port=control, file_port=files)


EVERY_S = 0.2
KEPT_CAPTURES = 64
EMULATED = ("camera", "optics", "mirror", "detector", "air", "sky")  # tables that say what the rig is like
USUAL_SIZE = (256, 256)  # of a built-in scene [px]


@dataclass(frozen=True)
class EmulateRequest:
    """What to emulate, and how."""

    settings: Settings
    baud: int = SurveyRig.baud
    speed: float = 1.0
    out: Path | None = None  # a survey's TOML to write

    def check(self) -> None:
        """Refuse a speed or a file that cannot be (SettingsError), before minutes are spent on the scene."""
        FastClock(self.speed)
        if self.baud < 0:
            raise SettingsError(f"--baud expects bits a second, or 0 for no pace, got {self.baud}")
        if self.out is not None and not self.out.parent.is_dir():
            raise SettingsError(f"--out {self.out}: there is no folder {self.out.parent}; make it, or choose another")


def emulated_settings(path: Path | None, flags: Mapping[str, object]) -> Settings:
    """Settings of what is emulated (SettingsError: one cannot be used); a built-in scene is small unless told."""
    wanted = load_settings(path, flags, usual={"source": "sim"})
    small = wanted.scene in BUILT_IN_SCENES and wanted.size is None
    return replace(wanted, size=USUAL_SIZE) if small else wanted


def run_emulate(
    request: EmulateRequest, console: Console, *, as_json: bool = False, ended: threading.Event | None = None
) -> int:
    """Emulate a rig until Ctrl-C, SIGTERM or ``ended``; how to connect goes to stdout, its state to ``console``."""
    request.check()
    with console.status("drawing the scene"):
        source, notes = emulated_source(request.settings)
    for note in notes:
        console.print(f"[dim]note: {escape(note)}[/]")
    clock = FastClock(request.speed)
    rig = EmulatedRig(source, clock, kept=KEPT_CAPTURES, mounting=request.settings.rig.mounting)
    with _ending(ended or threading.Event()) as end, rig.serve(baud=request.baud) as served:
        _tell(request, served, console, as_json=as_json)
        with console.status(_state(rig)) as line:
            while not end.wait(EVERY_S):
                line.update(_state(rig))
        console.print(f"closed: {_state(rig)}", soft_wrap=True)
    return 0


def _tell(request: EmulateRequest, served: ServedRig, console: Console, *, as_json: bool) -> None:
    table = _rig_table(served, request.settings.rig)
    if request.out is not None:
        try:
            settings = request.settings
            size = None if settings.size is None else f"{settings.size[0]}x{settings.size[1]}"
            names = ("scene", "size", "day", "hour", "bands", "wavelengths", "seed", "effects", "tol", "source")
            wanted = {name: getattr(settings, name) for name in names}
            wanted |= {"size": size, "tol": str(settings.tol), "source": "rig"}
            given = [f"{key} = {_toml_value(value)}" for key, value in wanted.items() if value is not None]
            tables = [_toml_table(name, values) for name, values in {**_tables_changed(settings), "rig": table}.items()]
            lines = ["# A survey of an emulated rig, for as long as that runs.", *given, "", *tables]
            request.out.write_text("\n".join(lines), encoding="utf-8")
        except OSError as error:
            raise SettingsError(f"cannot write {request.out}: {error.strerror}; choose another --out") from error
        console.print(f"survey it with: spectralzoom survey {escape(str(request.out))}")
    if as_json:
        print_json({"rig": table, "speed": request.speed, "toml": request.out and str(request.out)})
    else:
        sys.stdout.write(f"{_toml_table('rig', table)}\n")
    sys.stdout.flush()
    console.print("emulating a rig; Ctrl-C ends it")


def _rig_table(served: ServedRig, rig: SurveyRig) -> dict[str, object]:
    white_reference = served.rig.camera.view.source.scene.white_reference
    mounted = ("mirror_axes", "mirror_clocking_deg", "mirror_offset_x", "mirror_offset_y")
    return {
        "port": served.port,
        "host": served.host,
        "control_port": served.camera_port,
        "file_port": served.file_port,
        "pulses": served.rig.camera.wired,
        "white_reference": round(float(white_reference.mean()), 6),
        "provenance": "emulated",
        **{name: getattr(rig, name) for name in mounted if rig.mounting != STRAIGHT},
    }


def _tables_changed(settings: Settings) -> dict[str, dict[str, object]]:
    """What of the emulated rig is not usual, by table: a survey of it has to know the same camera."""
    asked, usual = settings.to_dict(), Settings().to_dict()
    found = {}
    for name in EMULATED:
        own, other = (cast("dict[str, object]", one[name]) for one in (asked, usual))
        if own != other:
            found[name] = {key: value for key, value in own.items() if value != other[key] and value is not None}
    return found


def _toml_table(name: str, values: dict[str, object]) -> str:
    return "\n".join([f"[{name}]", *(f"{key} = {_toml_value(value)}" for key, value in values.items()), ""])


def _toml_value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"[{', '.join(map(_toml_value, value))}]" if isinstance(value, tuple) else str(value)


def _state(rig: EmulatedRig) -> str:
    seen = rig.seen()
    x, y = seen.position
    last = f", last: {seen.last}" if seen.last else ""
    camera = "capturing" if seen.capturing else "idle"
    return escape(f"mirror {x:+.4f}; {y:+.4f}, {seen.mode}{last} | camera {camera}, {seen.captures} captures")


@contextmanager
def _ending(event: threading.Event) -> Iterator[threading.Event]:
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    before = {number: signal.signal(number, lambda *_: event.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def emulated_source(settings: Settings) -> tuple[SimulatedSource, tuple[str, ...]]:
    """The scene through the simulated rig, and what was assumed of it (PipelineError); nothing is kept."""
    with tempfile.TemporaryDirectory(prefix="spectralzoom-") as folder:
        apart = replace(settings, source="sim", out=str(Path(folder) / "effects"))
        run, _, notes = open_simulation(apart)
        effects, _ = choose_effects.produce(run.archive, choose_effects.wants(run))
        return source_with(run.simulated, effects), notes
