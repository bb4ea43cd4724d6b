"""Open the scene of a survey with its labels."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import BUILT_IN_SCENES, RIG, RIG_FIELD, SIM
from spectralzoom.pipeline.errors import NoSceneYet, SceneError, SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.simulator.scenes.built_in import built_in_scene
from spectralzoom.pipeline.simulator.scenes.daylight import sun_elevation_deg
from spectralzoom.pipeline.simulator.scenes.laws import FARM_SHAPE
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene, SceneRadiance, SceneRaster, raster_from_values
from spectralzoom.storage.addresses import split_variable
from spectralzoom.storage.readers.cube_sources import ONE_FILE, machine_bytes
from spectralzoom.storage.readers.labels import map_values
from spectralzoom.storage.readers.scene_files import SceneFile, load_scene_file, open_scene_file

# Peak of a survey of the farm, without the scene on disk: 1.42 GB for 1280 x 1024 px, 1.57 GB for 2560 x 2048 px
FARM_BYTES, FARM_BYTES_PER_PX = 1_350_000_000, 60
POSE_WINS = "[pose] replaces the georeference of the scene; leave [pose] out to keep it"
DATE = "{date"


def scene_of_visit(settings: Settings, moment: datetime) -> Settings:
    """Return the settings with the file that a scene pattern stands for; other settings unchanged.

    ``{date:%Y-%m-%d}`` is the date of ``moment``, in any strftime format. Raises SettingsError: other braces;
    NoSceneYet: there is no such file.
    """
    if DATE not in settings.scene:
        return settings
    try:
        found = settings.scene.format(date=moment)
    except (KeyError, IndexError, ValueError) as error:
        raise SettingsError(f"--scene {settings.scene}: {error} is not allowed; braces are {{date:%Y-%m-%d}}") from None
    if not split_variable(found)[0].exists():
        raise NoSceneYet(f"there is no file {found} yet, which --scene {settings.scene} stands for")
    return settings.but(scene=found)


def check_scene_there(scene: str) -> None:
    """Check that the file of a scene exists. Raises SceneError: it does not."""
    path, _ = split_variable(scene)
    if scene in (RIG_FIELD, *BUILT_IN_SCENES):
        return
    try:
        there = path.exists()
        what = "a link that leads nowhere," if path.is_symlink() else "no file"
    except OSError as error:  # such as a name longer than any
        raise SceneError(f"--scene {scene} cannot be the name of a file: {error.strerror}") from error
    if not there:
        many = f"; --scene takes no pattern, {ONE_FILE}" if "*" in scene else ""
        raise SceneError(f"there is {what} {path}; check the name of --scene (seen from {Path.cwd()}){many}")


def open_scene(settings: Settings) -> tuple[RasterScene, tuple[str, ...]]:
    """Open the scene in the light of the settings' sky; arguments, notes and errors as in `_in_clear_light`."""
    scene, notes = _in_clear_light(settings)
    return scene.in_light(settings.sky.fraction_of_clear), notes


def darkness(settings: Settings) -> tuple[str, ...]:
    """Return the warning that a simulated field is dark; or nothing."""
    is_lit = settings.source != SIM or settings.sky.started is None
    height = 1.0 if is_lit else float(sun_elevation_deg(settings.sky, np.zeros(1))[0])
    text = f"the sun is {-height:.0f} degrees below the horizon at sky.started: the field is dark"
    return () if height > 0 else (text,)


def _in_clear_light(settings: Settings) -> tuple[RasterScene, tuple[str, ...]]:
    """Open the scene, and return it with notes on assumptions.

    Raises SceneError,
    WavelengthError: the file is not valid; SettingsError: a setting is not for a built-in scene.
    """
    if settings.scene == RIG_FIELD:
        return _field_before_rig(settings), ()
    if settings.scene in BUILT_IN_SCENES:
        for name, value in {"labels": settings.labels, "wavelengths": settings.wavelengths}.items():
            if value is not None:
                raise SettingsError(f"--{name} is for scene files; the scene '{settings.scene}' brings its own")
        shape = settings.shape or FARM_SHAPE
        more: dict[str, Any] = {} if settings.interest is None else {"interest": settings.interest}
        moment = {"day": settings.day, "hour": settings.hour}
        farm = built_in_scene(settings.scene, settings.seed, shape, camera=settings.camera, **moment, **more)
        return farm if settings.bands is None else _some_bands(farm, settings.bands), ()
    file = load_scene_file(
        settings.scene, labels=settings.labels, bands=settings.bands, wavelengths=settings.wavelengths
    )
    return _with_notes(scene_of_file(file, settings.camera), file, settings, "given their band's median")


def scene_of_file(file: SceneFile, camera: LineCamera) -> RasterScene:
    """Turn a scene file into a scene of the simulator."""
    scene = raster_from_values(
        file.values,
        camera,
        name=file.name,
        wavelength_nm=file.wavelength_nm,
        fwhm_nm=file.fwhm_nm,
        labels=file.labels,
        class_names=file.class_names,
        class_colours=file.class_colours,
        key=file.light_hash,
        geobox=file.geobox,
    )
    values = map_values(file.class_values)
    zero = [name for name, value in zip(file.class_names, file.class_values, strict=True) if value in (0, (0, 0, 0))]
    scene = replace(scene, regridded=file.regridded, content=file.content, pixel_m=file.pixel_m)
    return replace(scene, class_values=values, zero_class="".join(zero))


def open_map(settings: Settings) -> tuple[SceneFile, RasterScene, tuple[str, ...]]:
    """Open a raster: its file, a scene without light, and notes. Labels beside it are used as in `open_scene`.

    Raises SceneError, WavelengthError: a file is not valid.
    """
    file = open_scene_file(
        settings.scene, labels=settings.labels, bands=settings.bands, wavelengths=settings.wavelengths
    )
    missing = file.missing if file.missing.any() else None
    labels = file.labels
    if labels is not None and missing is not None:
        labels = np.where(missing, np.uint8(UNLABELLED), labels)
    scene = unlit_scene(
        file.shape,
        file.wavelength_nm,
        labels=labels,
        name=file.name,
        key=file.light_hash,
        white_reference=np.ones(len(file.wavelength_nm), np.float32),
        fwhm_nm=file.fwhm_nm,
        class_names=file.class_names,
        class_colours=file.class_colours,
        filled_px=file.filled_px,
        missing=missing,
        geobox=file.geobox,
        pixel_m=file.pixel_m,
        content=file.content,
    )
    return file, *_with_notes(scene, file, settings, "whose other bands are used")


def _with_notes(
    scene: RasterScene, file: SceneFile, settings: Settings, became: str
) -> tuple[RasterScene, tuple[str, ...]]:
    """Return the scene of a file, without its georeference where a pose replaces it, and notes on both.

    ``became`` says what became of pixels without a value in some bands.
    """
    notes = file.provenance
    scene = replace(scene, acquired=file.acquired)
    if scene.geobox is not None and settings.pose is not None:
        scene = replace(scene, geobox=None)
        notes = (*notes, POSE_WINS)
    void = 0 if scene.missing is None else int(np.count_nonzero(scene.missing))
    counts = {f"some bands, {became}": scene.filled_px - void, "most bands, of no class in the map": void}
    return scene, (*notes, *(f"pixels without {what}: {count}" for what, count in counts.items() if count))


def _field_before_rig(settings: Settings) -> RasterScene:
    """Return a field of which only size and bands are known. Raises SettingsError: they are not given."""
    for name, value in {"size": settings.size, "wavelengths": settings.wavelengths}.items():
        if value is None:
            raise SettingsError(f"scene {RIG_FIELD!r} has no file: give its {name}")
    assert settings.size is not None
    assert settings.wavelengths is not None
    width, height = settings.size
    return unlit_scene(
        (height, width),
        np.array(settings.wavelengths, np.float64),
        white_e=settings.camera.full_scale_e,
        name=settings.name or RIG_FIELD,
        key=f"{RIG_FIELD}/{settings.name or ''}/{width}x{height}",
        white_reference=np.full(len(settings.wavelengths), settings.rig.white_reference, np.float32),
    )


def unlit_scene(
    shape: tuple[int, int],
    wavelength_nm: NDArray[np.float64],
    *,
    white_e: float = 1.0,
    labels: NDArray[np.uint8] | None = None,
    **more: Any,
) -> RasterScene:
    """Return a scene of (y, x) pixels without light, whose white reference gives ``white_e`` electrons a band."""
    bands = len(wavelength_nm)
    light = SceneRadiance(np.zeros((1, bands), np.float32), np.full(bands, white_e, np.float32))
    raster = SceneRaster.of(np.broadcast_to(np.float32(0), (*shape, 1)), labels)
    return RasterScene(raster=raster, light=Once.of(light), wavelength_nm=wavelength_nm, **more)


def farm_refusal(settings: Settings) -> str | None:
    """Return why the farm of the settings exceeds the memory of this machine; None where it fits."""
    if settings.scene not in BUILT_IN_SCENES or settings.shape is None:
        return None
    height, width = settings.shape
    needed, there = FARM_BYTES + height * width * FARM_BYTES_PER_PX, machine_bytes()
    if needed <= there:
        return None
    return (
        f"--size {width}x{height}: a survey of such a farm takes about {needed / 1e9:.0f} GB of memory,"
        f" this machine has {there / 1e9:.0f}; take a smaller one"
    )


def _some_bands(scene: RasterScene, bands: tuple[int, ...]) -> RasterScene:
    """Return the scene with some of its bands. Raises SettingsError: it has no such band."""
    count = len(scene.wavelength_nm)
    if not all(0 <= band < count for band in bands):
        raise SettingsError(f"--bands {','.join(map(str, bands))}: the scene has bands 0 to {count - 1}")
    chosen = list(bands)
    return replace(
        scene,
        key=f"{scene.key}/only={','.join(map(str, bands))}",
        light=Once(lambda: SceneRadiance(scene.electrons[:, chosen], scene.white_reference_electrons[chosen])),
        white_reference=scene.white_reference[chosen],
        wavelength_nm=scene.wavelength_nm[chosen],
        fwhm_nm=None if scene.fwhm_nm is None else scene.fwhm_nm[chosen],
    )


def for_rig(settings: Settings) -> Settings:
    """Return settings in which a visit of a rig has a name."""
    if settings.source != RIG or settings.visit is not None:
        return settings
    return settings.but(visit=f"{datetime.now(UTC):%Y-%m-%d}")
