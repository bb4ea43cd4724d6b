"""The verbs `rig check`, a table of questions and answers, and `rig emulate`, a rig behind a pty and sockets."""

from __future__ import annotations

import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, cast

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.cli.simulate_command import open_simulation
from flows.settings.documents import as_toml
from flows.settings.flags import NO_RENDERING_FLAGS, AsJson, OutFolder, RenderingFlags, Switch, by_setting
from flows.settings.load import anchor_paths, load_settings
from flows.settings.survey_settings import BUILT_IN_SCENES, Settings
from flows.tasks.stages.effects import choose_effects, chosen_effects
from flows.terminal.processes import DONE, FAILED, PARTLY
from flows.terminal.progress import on_stdout, print_json, stderr
from pipeline.errors import SettingsError
from pipeline.geometry.mirror import STRAIGHT
from pipeline.rig.device_settings import SurveyRig
from pipeline.rig.drivers import open_camera_driver, open_mirror_driver
from pipeline.rig.emulator.emulated_rig import EmulatedRig, FastClock
from pipeline.rig.rig_check import CheckRow, Device, check_camera, check_mirror, works
from pipeline.rig.transports import SYSTEM_CLOCK
from pipeline.simulator.simulated import SimulatedSource

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def check(
    settings: Path | None = None,
    *,
    port: str | None = None,
    camera: str | None = None,
    move: Switch = False,
    as_json: AsJson = False,
) -> int:
    """Connect to mirror and camera, read their state, and report problems with remedies.

    Exit code: 0 without problems, 3 if one of two devices works, 2 for a wrong setting or file, else 1.

    Parameters
    ----------
    settings
        Settings file (TOML) whose table [rig] has the addresses of both devices. Flags override it.
    port
        Port of the mirror controller: /dev/ttyACM0 or COM3. Without a settings file, only named devices are checked.
    camera
        Address of the camera: 10.0.65.50, HOST:PORT or HOST:PORT:FILE_PORT.
    move
        Also move the mirror along a small square, within 0.05 of the middle of its range, and read its positions back.
        It stops at 0; 0.
    """
    wanted = load_settings(settings)
    rig = wanted.rig if port is None else replace(wanted.rig, port=port)
    rig = rig if camera is None else _at(rig, camera)
    both = settings is not None or port is camera is None
    mirror_asked, camera_asked = both or port is not None, both or camera is not None
    rows: list[CheckRow] = []
    if mirror_asked:
        with stderr.status(f"asking the mirror at {escape(rig.port)}"):
            rows += check_mirror(partial(open_mirror_driver, rig, wanted.cost.vector_pairs), SYSTEM_CLOCK, move=move)
    if camera_asked:
        with stderr.status(f"asking the camera at {escape(rig.host)}"):
            rows += check_camera(partial(open_camera_driver, rig))
    asked: dict[Device, bool] = {"mirror": mirror_asked, "camera": camera_asked}
    good = [works(rows, device) for device, is_asked in asked.items() if is_asked]
    code = DONE if all(good) else PARTLY if any(good) else FAILED
    if not as_json:
        _print(rows, on_stdout())
        return code
    print_json(
        {
            "port": rig.port if mirror_asked else None,
            "camera": f"{rig.host}:{rig.control_port}" if camera_asked else None,
            "move": move,
            "rows": [asdict(row) for row in rows],
            "failed": sum(row.verdict == "fail" for row in rows),
            "warned": sum(row.verdict == "warn" for row in rows),
            "exit_code": code,
        }
    )
    return code


def _print(rows: Sequence[CheckRow], console: Console) -> None:
    table = Table("device", "asked", "came", "", box=SIMPLE_HEAD)
    for row in rows:
        table.add_row(row.device, escape(row.asked), escape(row.came), f"[{_COLOURS[row.verdict]}]{row.verdict}[/]")
    console.print(table)
    mend = [row for row in rows if row.mend]
    for row in mend:
        say = f"[{_COLOURS[row.verdict]}]{row.verdict}[/] {row.device}, {escape(row.asked)}: {escape(row.mend)}"
        console.print(say, soft_wrap=True)
    if not mend:
        console.print("nothing to mend")


def _at(rig: SurveyRig, camera: str) -> SurveyRig:
    """Return the rig with the camera at HOST, HOST:PORT or HOST:PORT:FILE_PORT."""
    host, *ports = camera.split(":")
    if not host or len(ports) > 2 or not all(port.isdecimal() and 0 < int(port) < 65536 for port in ports):
        raise SettingsError(f"--camera expects HOST, HOST:PORT or HOST:PORT:FILE_PORT, got {camera!r}")
    control, files = (*map(int, ports), *(rig.control_port, rig.file_port)[len(ports) :])
    return replace(rig, host=host, control_port=control, file_port=files)


EVERY_S = 0.2
EMULATED = ("camera", "optics", "mirror", "detector", "air", "sky")  # tables that describe the rig
USUAL_SIZE = (256, 256)  # of a built-in scene [px]


def emulated_settings(path: Path | None, flags: Mapping[str, object]) -> Settings:
    """Return the settings of the emulated rig; a built-in scene is small by default. Raises SettingsError."""
    wanted = load_settings(path, flags, usual={"source": "sim"})
    return replace(wanted, size=USUAL_SIZE) if wanted.scene in BUILT_IN_SCENES and wanted.size is None else wanted


def emulate(
    *,
    scene: str | None = None,
    size: str | None = None,
    flags: RenderingFlags = NO_RENDERING_FLAGS,
    settings: Path | None = None,
    baud: Annotated[int, Parameter(validator=Number(gte=0))] = SurveyRig.baud,
    speed: float = 1.0,
    out: OutFolder = None,
    as_json: AsJson = False,
) -> int:
    """Emulate a rig in front of a simulated scene, until Ctrl-C: a serial port and the sockets of a camera.

    Both use the documented protocols. The command prints the lines of a settings file that connect to them.

    Parameters
    ----------
    scene
        Scene: `farm` (`farm@2` names the version of its law), or an image or cube file. Default: `farm`.
    size
        Size of the scene `farm`, width x height [px]. Default: 256x256.
    settings
        Settings file (TOML) for camera, optics, light and the mounting of the mirror. Flags override it.
    baud
        Speed of the serial port [baud]; 0: no limit, like USB.
    speed
        Speed of the rig's clock, as a multiple of real time. With `pulses = "none"` only 1 gives lines a position.
    out
        Settings file (TOML) to write, for `survey` and `rig check`.
    """
    values = {"scene": scene, "size": size, **by_setting(flags)}
    return run_emulate(emulated_settings(settings, values), stderr, baud=baud, speed=speed, out=out, as_json=as_json)


def run_emulate(
    settings: Settings,
    console: Console,
    *,
    baud: int = SurveyRig.baud,
    speed: float = 1.0,
    out: Path | None = None,
    as_json: bool = False,
    ended: threading.Event | None = None,
) -> int:
    """Emulate a rig until Ctrl-C, SIGTERM or ``ended``; its addresses go to stdout, its state to ``console``.

    ``out`` is a survey's TOML to write. Raises SettingsError, before the scene is made: speed or file is invalid.
    """
    FastClock(speed)  # raises for an invalid speed
    if out is not None and not out.parent.is_dir():
        raise SettingsError(f"--out {out}: there is no folder {out.parent}; make it, or choose another")
    with console.status("drawing the scene"):
        source, notes = emulated_source(settings)
    for note in notes:
        console.print(f"[dim]note: {escape(note)}[/]")
    rig = EmulatedRig(source, FastClock(speed), mounting=settings.rig.mounting)
    with _ending(ended or threading.Event()) as end, rig.serve(baud=baud) as served:
        mounted = ("mirror_axes", "mirror_clocking_deg", "mirror_offset_x", "mirror_offset_y")
        table = {
            "port": served.port,
            "host": served.host,
            "control_port": served.camera_port,
            "file_port": served.file_port,
            "pulses": served.rig.camera.wired,
            "white_reference": round(float(served.rig.camera.view.source.scene.white_reference.mean()), 6),
            "provenance": "emulated",
            **{name: getattr(settings.rig, name) for name in mounted if settings.rig.mounting != STRAIGHT},
        }
        if out is not None:
            _write_survey(out, settings, table)
            console.print(f"survey it with: spectralzoom survey {escape(str(out))}")
        if as_json:
            print_json({"rig": table, "speed": speed, "toml": out and str(out)})
        else:
            sys.stdout.write(f"{_toml_table('rig', table)}\n")
        sys.stdout.flush()
        console.print("emulating a rig; Ctrl-C ends it")
        with console.status(escape(rig.state)) as line:
            while not end.wait(EVERY_S):
                line.update(escape(rig.state))
    console.print(f"closed: {escape(rig.state)}", soft_wrap=True)
    return 0


@contextmanager
def _ending(event: threading.Event) -> Iterator[threading.Event]:
    """Set the event at SIGINT or SIGTERM, also in a process started in the background, where SIGINT is ignored."""
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    before = {number: signal.signal(number, lambda *_: event.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _write_survey(out: Path, settings: Settings, table: dict[str, object]) -> None:
    """Write the settings of a survey of the emulated rig, with its table [rig]."""
    names = ("size", "day", "hour", "interest", "bands", "wavelengths", "seed", "effects", "tol", "source")
    described = anchor_paths(settings.to_dict(), Path.cwd())
    wanted = {name: described[name] for name in ("scene", "labels")} | {name: getattr(settings, name) for name in names}
    wanted |= {
        "size": None if settings.size is None else f"{settings.size[0]}x{settings.size[1]}",
        "tol": str(settings.tol),
        "source": "rig",
    }
    given = [f"{key} = {as_toml(value)}" for key, value in wanted.items() if value is not None]
    parts = {name: cast("dict[str, object]", described[name]) for name in EMULATED}
    known = {name: {key: one for key, one in part.items() if one is not None} for name, part in parts.items()}
    tables = [_toml_table(name, values) for name, values in {**known, "rig": table}.items()]
    text = "\n".join(["# A survey of an emulated rig, for as long as that runs.", *given, "", *tables])
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise SettingsError(f"cannot write {out}: {error.strerror}; choose another --out") from error


def _toml_table(name: str, values: dict[str, object]) -> str:
    return "\n".join([f"[{name}]", *(f"{key} = {as_toml(value)}" for key, value in values.items()), ""])


def emulated_source(settings: Settings) -> tuple[SimulatedSource, tuple[str, ...]]:
    """Return the simulated source of the scene, and assumptions on it; nothing is stored. Raises PipelineError."""
    with tempfile.TemporaryDirectory(prefix="spectralzoom-") as folder:
        run, _, notes = open_simulation(replace(settings, source="sim", out=str(Path(folder) / "effects")))
        effects, _ = choose_effects.produce(run.archive, choose_effects.wants(run))
        return replace(run.simulated, chosen=chosen_effects(effects)), notes
