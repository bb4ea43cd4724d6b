"""Verbs on a rig: is it there and well, and one to try them on that is emulated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from flows.cli.app import AsJson, Switch, app, split_list, stderr

rig = App(name="rig", help="Check a rig before a survey, or emulate one to try surveys on.")
app.command(rig)


@rig.command
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
    from flows.simulate.rig_check_command import check_request, run_check

    return run_check(check_request(settings, port, camera, move=move), stderr, as_json=as_json)


@rig.command
def emulate(
    *,
    scene: str | None = None,
    size: str | None = None,
    seed: str | None = None,
    day: str | None = None,
    hour: str | None = None,
    bands: str | None = None,
    wavelengths: str | None = None,
    effects: str | None = None,
    settings: Path | None = None,
    faults: str | None = None,
    baud: int = 115200,
    speed: float = 1.0,
    out: Annotated[Path | None, Parameter(name=("--out", "-o"))] = None,
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
    seed
        Of the scene `farm` and of all noise; 0 by default.
    day
        Of the year, 1 to 366, for the scene `farm`: 172 by default.
    hour
        True solar time [h], for the scene `farm`: 11 by default.
    bands
        Bands of the file (or of the farm's 270) to use, from 0: 0,1
    wavelengths
        Their centre wavelengths [nm]: 660,800
    effects
        Of the simulated rig, as `survey` takes them; auto by default.
    settings
        A survey's TOML file, for what camera, optics and light are like, and how the mirror is mounted. Flags win over
        it.
    faults
        What goes wrong, with commas, each as name or name:seed; `list` shows all.
    baud
        Speed of the serial port's bytes; 0 lets them through as they come, as USB does.
    speed
        How many times as fast as the clock on the wall the rig's time goes.
    out
        A survey's TOML file to write, ready for `survey` and `rig check`.
    """
    from flows.simulate.rig_check_command import LIST, show_faults
    from flows.simulate.rig_emulation import EmulateRequest, emulated_settings, run_emulate

    words = split_list(faults)
    if words == (LIST,):
        return show_faults(as_json=as_json)
    flags = {
        "scene": scene, "size": size, "seed": seed, "day": day, "hour": hour, "bands": bands,
        "wavelengths": wavelengths, "effects": effects,
    }  # fmt: skip
    request = EmulateRequest(emulated_settings(settings, flags), words, baud, speed, out)
    return run_emulate(request, stderr, as_json=as_json)
