"""Define the verbs that take the settings of a survey: survey, simulate, rig check and rig emulate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from flows.cli.app import AsJson, OutFolder, Switch, stderr
from flows.settings.documents import about, toml_value
from flows.settings.load import SURVEY, TABLES, load_settings
from flows.terminal.progress import print_json
from pipeline.errors import NothingToMend
from pipeline.lazy import deferred
from pipeline.rig.device_settings import SurveyRig

if TYPE_CHECKING:
    import flows.publish.survey_command as survey_command
    import flows.simulate.command as simulate_command
    import flows.simulate.rig_commands as rig_commands
else:
    survey_command = deferred("flows.publish.survey_command")
    simulate_command = deferred("flows.simulate.command")
    rig_commands = deferred("flows.simulate.rig_commands")

OF_ZONES = ("area", "no_go", "plots", "plots_name")
# flag: setting in a table
IN_TABLES = {"exposure_ms": "camera.exposure_ms", "sky": "sky.light", "light_fraction": "sky.light_fraction"}
IN_TABLES |= {name: f"zones.{name}" for name in OF_ZONES}
_IN_TABLES = {name: place.partition(".") for name, place in IN_TABLES.items()}
_DECLARED = SURVEY | {name: TABLES[table][key] for name, (table, _, key) in _IN_TABLES.items()}


def _flags(names: Iterable[str]) -> Any:
    """Return a dataclass of flags for these settings; None stands for a flag that is not given."""
    made = []
    for name in names:
        one = _DECLARED[name]
        kind: Any = bool if one.kind is bool else str
        help_text = about(one) + ("" if one.item.default is None else f"; default: {toml_value(one).strip(chr(34))}")
        made.append((name, Annotated[kind | None, Parameter(help=help_text)], None))
    return make_dataclass("Flags", made, frozen=True, kw_only=True)


_RENDERING = ("effects", "seed", "day", "hour", "interest", "sky", "light_fraction", "bands", "wavelengths")
_Every: Any = _flags(name for name in _DECLARED if name not in TABLES or name in IN_TABLES)
_OfRendering: Any = _flags(_RENDERING)
_OfSimulation: Any = _flags((*_RENDERING, "tol", "size", "exposure_ms", "workers"))


@Parameter(name="*")
class SurveyFlags(_Every):  # type: ignore[misc]
    """Flags of all settings of a survey."""


@Parameter(name="*")
class RenderingFlags(_OfRendering):  # type: ignore[misc]
    """Flags of the simulated rig and its light."""


@Parameter(name="*")
class SimulationFlags(_OfSimulation):  # type: ignore[misc]
    """Flags of a simulated scan."""


def by_setting(flags: Any) -> dict[str, object]:
    """Return the values of flags by setting, for `load_settings`."""
    return {IN_TABLES.get(name, name): value for name, value in asdict(flags).items()}


NO_FLAGS = SurveyFlags()
Verbose = Annotated[
    bool, Parameter(name=("--verbose", "-v"), negative="", help="Print all savings, stages and effects.")
]
NO_SIMULATION_FLAGS = SimulationFlags()
NO_RENDERING_FLAGS = RenderingFlags()


def survey(
    settings: Path | None = None, *, flags: SurveyFlags = NO_FLAGS, as_json: AsJson = False, verbose: Verbose = False
) -> int:
    """Survey a field: capture it in one or two passes, map its classes, and publish a receipt and a report.

    Parameters
    ----------
    settings
        Settings file (TOML); flags override it. Default: none.
    """
    requested = load_settings(settings, by_setting(flags))
    try:
        published = survey_command.run_survey(requested, stderr, verbose=verbose)
    except NothingToMend as skipped:
        if as_json:
            print_json({"captured": False, "run": skipped.run, "why": str(skipped)})
        stderr.print(f"{skipped}", markup=False, soft_wrap=True)
        return 0
    if as_json:
        print_json(published.receipt)
    return 0


def simulate(
    scene: str,
    *,
    out: Annotated[str, Parameter(name=("--out", "-o"))],
    coarse: Switch = False,
    settings: Path | None = None,
    flags: SimulationFlags = NO_SIMULATION_FLAGS,
    as_json: AsJson = False,
) -> int:
    """Simulate a full scan of SCENE, and list the effects that were simulated or omitted, with reasons.

    The same command resumes a stopped scan; a finished scan is not repeated.

    Parameters
    ----------
    scene
        `farm` or `scouting` (built in; with a seed: `farm@2`), or an image or cube file: PNG, JPEG, BMP, GeoTIFF,
        .npy, .npz, .mat, ENVI, Zarr.
    out
        Archive for the raw cubes: a folder, or s3://bucket/prefix.
    coarse
        Simulate the coarse sweep instead: every fourth line, samples summed by four.
    settings
        Settings file (TOML) with the tables [camera], [optics], [mirror], [detector], [air] and [sky]. Flags override
        it.
    """
    values = {"scene": scene, "out": out, "source": "sim", **by_setting(flags)}
    record = simulate_command.run_simulate(load_settings(settings, values), stderr, coarse=coarse)
    if as_json:
        print_json(record)
    return 0


def check(
    settings: Path | None = None,
    *,
    port: str | None = None,
    camera: str | None = None,
    move: Switch = False,
    as_json: AsJson = False,
) -> int:
    """Connect to mirror and camera, read their state, and report problems with remedies. Nothing moves.

    Exit code: 0 without problems, 3 if one of two devices works, else 1.

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
    return rig_commands.run_check(settings, port, camera, stderr, move=move, as_json=as_json)


def emulate(
    *,
    scene: str | None = None,
    size: str | None = None,
    flags: RenderingFlags = NO_RENDERING_FLAGS,
    settings: Path | None = None,
    baud: int = SurveyRig.baud,
    speed: float = 1.0,
    out: OutFolder = None,
    as_json: AsJson = False,
) -> int:
    """Emulate a rig in front of a simulated scene, until Ctrl-C: a serial port and the sockets of a camera.

    Both use the documented protocols. The command prints the lines of a settings file that connect to them.

    Parameters
    ----------
    scene
        Scene: `farm` (with a seed: `farm@2`), or an image or cube file. Default: `farm`.
    size
        Size of the scene `farm`, width x height [px]. Default: 256x256.
    settings
        Settings file (TOML) for camera, optics, light and the mounting of the mirror. Flags override it.
    baud
        Speed of the serial port [baud]; 0: no limit, like USB.
    speed
        Speed of the rig's clock, as a multiple of real time.
    out
        Settings file (TOML) to write, for `survey` and `rig check`.
    """
    values = {"scene": scene, "size": size, **by_setting(flags)}
    requested = rig_commands.emulated_settings(settings, values)
    return rig_commands.run_emulate(requested, stderr, baud=baud, speed=speed, out=out, as_json=as_json)
