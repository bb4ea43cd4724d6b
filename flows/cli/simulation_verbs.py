"""The verb that simulates a scan of a scene without surveying it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from flows.cli.app import AsJson, Switch, app, print_json, stderr


@app.command
def simulate(
    scene: str,
    *,
    out: Annotated[str, Parameter(name=("--out", "-o"))],
    coarse: Switch = False,
    settings: Path | None = None,
    effects: str | None = None,
    tol: str | None = None,
    seed: str | None = None,
    size: str | None = None,
    day: str | None = None,
    hour: str | None = None,
    bands: str | None = None,
    wavelengths: str | None = None,
    exposure_ms: str | None = None,
    workers: str | None = None,
    compare: Path | None = None,
    as_json: AsJson = False,
) -> int:
    """Simulate a scan of all of SCENE with the effects that matter to it, and tell which were left out and why.

    The same command goes on where it was stopped; a scan that is there is not made again.

    Parameters
    ----------
    scene
        `farm` (built in; `farm@2`), or an image or cube file: PNG, JPEG, GeoTIFF, .npy, .npz, .mat,
        ENVI, Zarr.
    out
        Archive for the raw cubes: a folder, or s3://bucket/prefix.
    coarse
        Take the coarse sweep instead: every fourth line, samples summed by four.
    settings
        A survey's TOML file, for what the rig, the air and the light are like: [camera], [optics], [mirror],
        [detector], [air], [sky]. Flags win over it.
    effects
        auto (default: those that change a number by more than --tol), all, none, or names with commas:
        rotation,slit,smear,vignetting,shot,read-noise
    tol
        What leaving effects out may change any number by: in sigmas of its noise, 0.1 by default, or in DN, 0.5dn.
        With 0 everything is computed exactly, with inf all is left out that can be.
    seed
        Of the scene `farm` and of all that is drawn by chance; 0 by default.
    size
        Of the scene `farm`, width x height [px]: 1280x1024 by default.
    day
        Of the year, 1 to 366, for the scene `farm`: 172 by default.
    hour
        True solar time [h], for the scene `farm`: 11 by default; the sun stands in the south at 12.
    bands
        Bands of the file (or of the farm's 270) to use, from 0: 0,1
    wavelengths
        Their centre wavelengths [nm]: 660,800
    exposure_ms
        Exposure of a line [ms]; 100 by default.
    workers
        Blocks of lines to render at a time; one a core by default. The same bytes come out.
    compare
        A PNG to write: lines with everything on and exact, the same as simulated, and where they differ, with the times
        of both. Takes all lines once more both ways, or as many as about a minute allows.
    """
    from flows.settings.survey_settings import load_settings
    from flows.simulate.command import run_simulate

    flags = {
        "scene": scene, "out": out, "effects": effects, "tol": tol, "seed": seed, "size": size, "day": day,
        "hour": hour, "bands": bands, "wavelengths": wavelengths, "camera.exposure_ms": exposure_ms,
        "workers": workers,
    }  # fmt: skip
    record = run_simulate(load_settings(settings, flags), stderr, coarse=coarse, picture=compare)
    if as_json:
        print_json(record)
    return 0
