"""Verbs on a rig: is it there and well, and one to try them on that is emulated."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

from flows.cli.app import AsJson, Switch, app, stderr

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
