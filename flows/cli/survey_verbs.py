"""Verbs that take a survey's settings: survey, simulate, and check or emulate a rig."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from flows.cli.app import AsJson, OutFolder, Switch, stderr
from flows.settings.documents import about, shown
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
# flags of what a settings file has in a table
IN_TABLES = {"exposure_ms": "camera.exposure_ms", "sky": "sky.light", "light_fraction": "sky.light_fraction"}
IN_TABLES |= {name: f"zones.{name}" for name in OF_ZONES}
_IN_TABLES = {name: place.partition(".") for name, place in IN_TABLES.items()}
_DECLARED = SURVEY | {name: TABLES[table][key] for name, (table, _, key) in _IN_TABLES.items()}


def _flags(names: Iterable[str]) -> Any:
    """A dataclass of such flags, all of them None where nothing was given."""
    given = []
    for name in names:
        one = _DECLARED[name]
        kind: Any = bool if one.kind is bool else str
        said = about(one) + ("" if one.item.default is None else f"; {shown(one).strip(chr(34))} by default")
        given.append((name, Annotated[kind | None, Parameter(help=said)], None))
    return make_dataclass("Flags", given, frozen=True, kw_only=True)


_RENDERING = ("effects", "seed", "day", "hour", "interest", "sky", "light_fraction", "bands", "wavelengths")
_Every: Any = _flags(name for name in _DECLARED if name not in TABLES or name in IN_TABLES)
_OfRendering: Any = _flags(_RENDERING)
_OfSimulation: Any = _flags((*_RENDERING, "tol", "size", "exposure_ms", "workers"))


@Parameter(name="*")
class SurveyFlags(_Every):  # type: ignore[misc]
    """Flags of a survey's settings; None where none was given."""


@Parameter(name="*")
class RenderingFlags(_OfRendering):  # type: ignore[misc]
    """Flags of how a simulated rig sees its scene."""


@Parameter(name="*")
class SimulationFlags(_OfSimulation):  # type: ignore[misc]
    """The same, and how it is computed."""


def by_setting(flags: Any) -> dict[str, object]:
    """Values of flags by the settings that they are of, as `load_settings` takes them."""
    return {IN_TABLES.get(name, name): value for name, value in asdict(flags).items()}


NO_FLAGS = SurveyFlags()
Verbose = Annotated[
    bool, Parameter(name=("--verbose", "-v"), negative="", help="Print all savings, stages, effects and versions.")
]
NO_SIMULATION_FLAGS = SimulationFlags()
NO_RENDERING_FLAGS = RenderingFlags()


def survey(
    settings: Path | None = None, *, flags: SurveyFlags = NO_FLAGS, as_json: AsJson = False, verbose: Verbose = False
) -> int:
    """Survey a field: by the scan that promises most for the seconds, or coarsely, then finely where that changes it.

    Parameters
    ----------
    settings
        A survey's TOML file; flags win over it. Without one, flags and defaults alone.
    """
    asked = load_settings(settings, by_setting(flags))
    try:
        published = survey_command.run_survey(asked, stderr, verbose=verbose)
    except NothingToMend as said:
        if as_json:
            print_json({"captured": False, "run": said.run, "why": str(said)})
        stderr.print(f"{said}", markup=False, soft_wrap=True)
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
    """Simulate a scan of all of SCENE with the effects that matter to it, and tell which were left out and why.

    The same command goes on where it was stopped; a scan that is there is not made again.

    Parameters
    ----------
    scene
        `farm` or `scouting` (built in; `farm@2`, `scouting@1`), or an image or cube file: PNG, JPEG, BMP, GeoTIFF,
        .npy, .npz, .mat, ENVI, Zarr.
    out
        Archive for the raw cubes: a folder, or s3://bucket/prefix.
    coarse
        Take the coarse sweep instead: every fourth line, samples summed by four.
    settings
        A survey's TOML file, for what the rig, the air and the light are like: [camera], [optics], [mirror],
        [detector], [air], [sky]. Flags win over it.
    """
    given = {"scene": scene, "out": out, "source": "sim", **by_setting(flags)}
    record = simulate_command.run_simulate(load_settings(settings, given), stderr, coarse=coarse)
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
    """Connect to mirror and camera, read what they are and how they are, and tell what to mend. Nothing moves.

    The exit code is 0 where nothing failed, 3 where one of two devices works, else 1.

    Parameters
    ----------
    settings
        A survey's TOML file; its table [rig] says where both devices are. Flags win over it.
    port
        Port of the mirror controller, /dev/ttyACM0 or COM3. Without a file only what is named is checked.
    camera
        Address of the camera: 10.0.65.50, HOST:PORT or HOST:PORT:FILE_PORT.
    move
        Also send the mirror round a small square, within 0.05 of the middle of its range, and read back where it went.
        It ends at 0; 0.
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
    """Emulate a rig that looks at a simulated scene, until Ctrl-C: a serial port and a camera's sockets.

    They speak the bytes of the documented protocols. The lines of a settings file that reach them are printed.

    Parameters
    ----------
    scene
        What it looks at: `farm` (by default; `farm@2`), or an image or cube file.
    size
        Of the scene `farm`, width x height [px]: 256x256 by default.
    settings
        A survey's TOML file, for what camera, optics and light are like, and how the mirror is mounted. Flags win over
        it.
    baud
        Speed of the serial port's bytes; 0 lets them through as they come, as USB does.
    speed
        How many times as fast as the clock on the wall the rig's time goes.
    out
        A survey's TOML file to write, ready for `survey` and `rig check`.
    """
    given = {"scene": scene, "size": size, **by_setting(flags)}
    asked = rig_commands.emulated_settings(settings, given)
    return rig_commands.run_emulate(asked, stderr, baud=baud, speed=speed, out=out, as_json=as_json)
