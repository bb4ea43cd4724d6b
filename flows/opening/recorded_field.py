"""Open the recording of a survey, and its scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spectralzoom.flows.opening.scene import unlit_scene
from spectralzoom.flows.opening.visit import time_of_visit
from spectralzoom.flows.settings.load import merged, nested, unnested
from spectralzoom.flows.settings.rules import OF_THE_PLAN, changed, completed
from spectralzoom.flows.settings.settings import MOST_STEP, Settings, parse_settings
from spectralzoom.flows.settings.values import ALWAYS, AUTO, BUILT_IN_SCENES, RECORDED
from spectralzoom.pipeline.capture.recorded import Recording
from spectralzoom.pipeline.capture.recorded_passes import sweeps_as_taken
from spectralzoom.pipeline.capture.straight_scans import EDGE_PX, covered_field
from spectralzoom.pipeline.errors import SceneError, SettingsError
from spectralzoom.pipeline.rig.device_settings import OF_THE_LIGHT
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.storage.readers.recordings import find_recorded_run, open_recording
from spectralzoom.storage.readers.scene_files import load_field_labels
from spectralzoom.storage.runs import Run
from spectralzoom.storage.store import is_archive, stage_key

OFF_CENTRE_PX = 0.5  # least offset of a recorded field that is noted
OF_THE_RUN = (
    *("camera", "cost", "rig", "pose", "area", "plots", "plots_name", "resampling", "pointing_px", "seed", "sky"),
    *("weights", "expected_loss", "signal"),
)
BUILT_IN_WEIGHTS = "farm"


def usual_of_recording(stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return the defaults beside stated ``sweeps``: the settings of the run that took them; empty for others.

    So `survey --sweeps ARCHIVE/runs/NAME` plans as that run did, and its visit is the time of that run.
    Raises SceneError, ArchiveError: there is no such recording or run.
    """
    sweeps = stated.get("sweeps") if stated.get("source", AUTO) in (AUTO, RECORDED) else None
    found = find_recorded_run(sweeps) if isinstance(sweeps, str | Path) else None
    if found is None:
        return {}
    run, shape, _ = found
    requested = {name for name in OF_THE_PLAN if stated.get(name) is not None}
    uniform = run.settings.get("zoom") != ALWAYS and (run.settings.get("seconds") or run.settings.get("scan_step"))
    another_plan = requested - {"macs"} if uniform else requested & {"seconds", "scan_step", "macs"}
    names = OF_THE_RUN if another_plan else (*OF_THE_RUN, *OF_THE_PLAN)
    usual = {name: run.settings[name] for name in names if run.settings.get(name) is not None}
    if isinstance(rig := usual.get("rig"), Mapping):
        usual["rig"] = {name: one for name, one in rig.items() if name in OF_THE_LIGHT}
    usual |= {"name": str(run.receipt.get("survey") or run.folder.name), "visit": time_of_visit(run)}
    usual |= {} if shape is None else {"size": shape[::-1]}
    if run.settings.get("weights") is None and run.settings.get("scene") in BUILT_IN_SCENES:
        usual["weights"] = BUILT_IN_WEIGHTS
    return usual


def as_its_run(settings: Settings) -> Settings:
    """Return settings of recorded sweeps with those of the run that took them, where nothing else is stated."""
    names = settings.model_fields_set
    tables = set(changed(settings, *names))
    every = unnested(settings.to_dict())
    stated = nested({key: one for key, one in every.items() if key in tables or key in names})
    usual = usual_of_recording(stated)
    return parse_settings(completed(merged(usual, stated))) if usual else settings


def open_recorded(settings: Settings) -> tuple[Settings, Recording]:
    """Open the recording of the settings, without reading lines; return it, and the settings with its camera and size.

    Settings that are not stated are those of the run that took the lines.

    Raises SceneError, WavelengthError, SettingsError, ArchiveError, PoseError: as `open_recording`, or its lines are
    too far apart.
    """
    sweeps, out = Path(str(settings.sweeps)).resolve(), Path(settings.out).resolve()
    if out == (sweeps.parent if sweeps.is_file() else sweeps) and not is_archive(settings.out):
        raise SettingsError(
            f"--out = {settings.out!r} is the folder of the sweeps, and would hide them; choose another one"
        )
    settings = as_its_run(settings)
    recording = open_recording(
        str(settings.sweeps),
        settings.camera,
        pointing=None if settings.pointing is None else Path(settings.pointing),
        dark=None if settings.dark is None else Path(settings.dark),
        white=None if settings.white is None else Path(settings.white),
        wavelengths=settings.wavelengths,
        white_reference=settings.rig.white_reference,
        mounting=settings.rig.mounting,
    )
    shape, notes = _field_shape(recording, settings.shape, settings.sweeps)
    recording = replace(recording, notes=(*recording.notes, *notes))
    camera = recording.camera
    if (found := find_recorded_run(str(settings.sweeps))) is not None:  # its full scan has the exposure of its camera
        run, of_run, place = found
        camera = replace(camera, exposure_ms=float(run.settings["camera"]["exposure_ms"]))
        if camera.exposure_ms != settings.camera.exposure_ms:
            raise SettingsError("camera.exposure_ms is for a camera, and recorded lines have their own: leave it out")
        recording = replace(recording, acquired=time_of_visit(run))
        if of_run == shape and settings.pose is None:
            recording = replace(recording, geobox=place, pixel_m=_pixel_of(run))
    settings = settings.but(camera=camera, size=shape[::-1])
    if settings.as_taken:
        step = max(sweep.step for sweep in sweeps_as_taken(recording))
        if step > MOST_STEP:
            raise SceneError(
                f"the lines of the recording lie {step} px of {recording.camera.ifov_rad * 1e6:.4g} urad apart, and a "
                f"uniform scan may have up to {MOST_STEP} px between lines; correct the pointing, or "
                "camera.focal_length_mm"
            )
    return settings, recording


def recorded_scene(settings: Settings, recording: Recording) -> tuple[RasterScene, tuple[str, ...]]:
    """Return the field as a scene with size, bands and the labels of the settings; and notes.

    Raises SceneError: the labels are not valid.
    """
    assert settings.size is not None
    width, height = settings.size
    found = None
    notes: tuple[str, ...] = ()
    if settings.labels is not None:
        found, notes = load_field_labels(settings.labels, (height, width))
    scene = unlit_scene(
        (height, width),
        recording.wavelength_nm,
        white_e=settings.camera.full_scale_e,
        labels=None if found is None else found.index,
        name=settings.name or (Path(str(settings.sweeps).rstrip("/")).stem or RECORDED),
        key=f"{RECORDED}/{stage_key(RECORDED, 1, recording.key)}/{width}x{height}",
        white_reference=recording.sweeps[0].references.white_reference,
        fwhm_nm=recording.fwhm_nm,
        class_names=() if found is None else found.names,
        class_colours=np.zeros((0, 3), np.uint8) if found is None else found.colours,
        geobox=recording.geobox,
        acquired=recording.acquired,
        pixel_m=recording.pixel_m,
    )
    return scene.in_light(settings.sky.fraction_of_clear), (*recording.notes, *notes)


def _pixel_of(run: Run) -> float | None:
    """Return the side of a pixel on the ground of a run without a pose; None where it knows none."""
    known = (run.receipt.get("field") or {}).get("ground_pixel_m")
    return None if run.settings.get("pose") is not None else known


def _field_shape(
    recording: Recording, stated: tuple[int, int] | None, where: str | None
) -> tuple[tuple[int, int], tuple[str, ...]]:
    """Return the size (y, x) of the field around the direction at rest, as stated or covered; and notes."""
    if stated is not None:
        return stated, ()
    tangents = [np.where(one.valid_line[:, None], one.tangents, np.nan) for one in recording.sweeps]
    covered, (y, x) = covered_field([one.sweep for one in recording.sweeps], tangents, recording.camera)
    height, width = (int(size - 2 * abs(off) + EDGE_PX) for size, off in zip(covered, (y, x), strict=True))
    if min(height, width) < 1:
        raise SceneError(
            f"the field of {where} lies {x:.4g} px across and {y:.4g} px along the scan beside the direction at rest, "
            "and does not include it; correct the pointing, or give --size WIDTHxHEIGHT"
        )
    if max(abs(y), abs(x)) < OFF_CENTRE_PX:
        return (height, width), ()
    note = (
        f"the recorded field lies {x:.4g} px across and {y:.4g} px along the scan beside the direction at rest: "
        f"{width} x {height} px around it are surveyed; --size extends them"
    )
    return (height, width), (note,)
