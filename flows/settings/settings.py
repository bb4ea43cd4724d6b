"""Define the settings of a survey, each once: type, default, range, unit and one line of help.

The TOML, the flags, Prefect's form, the example file and the manual follow from the model `Settings`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    model_serializer,
    model_validator,
)

from spectralzoom.flows.settings.load import (
    FLAG,
    anchor_paths,
    declared,
    known_only,
    merged,
    nested,
    read_file,
    sentence_of,
    unnested,
)
from spectralzoom.flows.settings.rules import completed, mistakes, with_source
from spectralzoom.flows.settings.values import (
    ALWAYS,
    AUTO,
    BUILT_IN_SCENES,
    RASTER,
    RECORDED,
    RIG,
    SIM,
    WHOLE,
    Bands,
    Budget,
    Compute,
    Effects,
    Extent,
    Limit,
    Memory,
    Name,
    Scheduler,
    Size,
    VisitName,
    Wavelengths,
)
from spectralzoom.models.network.machine import PROCESSOR, Device
from spectralzoom.models.policies.policies import Policy
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import CostModel
from spectralzoom.pipeline.ground.view import RigPose
from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rig.device_settings import FAKE, SurveyRig
from spectralzoom.pipeline.setting_fields import CONFIG, Text, stated
from spectralzoom.pipeline.signal.components import SignalChoice
from spectralzoom.pipeline.simulator.effects.probe import Tolerance
from spectralzoom.pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Rig, Sky
from spectralzoom.pipeline.simulator.scenes.laws import FARM_SHAPE, LAWS, USUAL_DAY, USUAL_HOUR

USUAL_SIZE = f"{FARM_SHAPE[1]}x{FARM_SHAPE[0]}"
OF_THE_MACHINE = ("scheduler", "workers", "bucket", "device")  # settings that depend on the machine of the survey
MOST_STEP = 8  # greatest line spacing [px]
STORED = {"": "stored"}  # context of settings that were checked before: they are whole
SCENE, TIME, OUTPUT, MACHINE = "Scene", "Time and accuracy", "Output", "Machine"  # groups of the help's first page


class Settings(BaseModel):
    """Settings of one survey; all have defaults."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True, **CONFIG)

    settings_file: str | None = Field(default=None, exclude=True)
    """Settings file (TOML) on the machine of the survey; other parameters override it"""
    scene: Text = stated("farm", group=SCENE)
    """Scene: farm, scouting or trial (built in; --seed gives another), or a file: PNG, GeoTIFF, ENVI, Zarr and others.
    A folder of tiles, or tiles/*.tif, is one run a tile on the command line. Pattern for repeated visits:
    {date:%Y-%m-%d}.tif"""
    labels: Text | None = stated(None, example="labels.png", group=SCENE)
    """Label image on the scene's pixels (class colours or numbers); enables accuracy"""
    bands: Bands | None = stated(None, example=(0, 1))
    """Band numbers to use, counted from 0: 0,1 or 0-3; default: all"""
    wavelengths: Wavelengths | None = stated(None, unit="nm", example=(660.0, 800.0), group=SCENE)
    """Centre wavelengths of these bands: 660,800"""
    source: Literal["auto", "sim", "rig", "raster", "recorded"] = stated(AUTO, group=SCENE)
    """Pixel source: sim (simulated rig), rig (hardware of table [rig]), raster (pixels of the file as they are),
    recorded (the sweeps of --sweeps); auto: recorded with --sweeps, raster for files, sim for built-in scenes, rig for
    the scene `field`"""
    sweeps: Text | None = stated(None, example="sweeps", group=SCENE)
    """Recorded sweeps: an archive, ARCHIVE/runs/NAME, a folder of ENVI cubes or of a Headwall camera, or one ENVI or
    Zarr cube. Without another scan or budget, every line is used as it was taken"""
    pointing: Text | None = stated(None, example="pointing.csv")
    """Pointing of the recorded lines: a table with one row per line (CSV), or a folder with one table per cube;
    default: NAME.pointing.csv beside each cube"""
    dark: Text | None = stated(None, example="dark.hdr")
    """Dark frame of recorded sweeps, ENVI or .npy; default: NAME.dark.hdr or dark*.hdr"""
    white: Text | None = stated(None, example="white.hdr")
    """White frame of recorded sweeps, likewise; default: NAME.white.hdr or white*.hdr"""
    size: Size | None = stated(
        None, f"Size of a built-in scene, width x height; default: {USUAL_SIZE}", "px", example=USUAL_SIZE, group=SCENE
    )
    day: int | None = stated(
        None, f"Day of the year of a built-in scene; default: {USUAL_DAY} (21 June)", "", 1, 366, example=USUAL_DAY
    )
    hour: float | None = stated(
        None, f"True solar time of a built-in scene; default: {USUAL_HOUR:g}", "h", 0, 24, example=USUAL_HOUR
    )
    interest: float | None = stated(None, ge=0, le=1, example=0.0625)
    """Fraction of the scene scouting with weeds, bare ground, poor growth or lodging; default: 0.02 to 0.1 by seed"""
    seed: int = stated(0, ge=0, le=2**63 - 1)
    """Random seed of built-in scenes and of all noise"""
    name: Name | None = stated(None, example="north", group=SCENE)
    """Field name; default: the scene's"""
    visit: VisitName | None = stated(None, example="first of June", group=SCENE)
    """Visit: a date as YYYY-MM-DD, or any text. A new visit captures again; the same visit resumes"""
    prior: Text = stated(AUTO, group=SCENE)
    """Prior map of the field: latest (newest run), a run's name, or none; auto: latest under `serve`, else none"""
    area: Text | None = stated(None, example="area.geojson", group=SCENE)
    """Area of interest: polygons as GeoJSON, GeoPackage (FILE.gpkg:LAYER) or shapefile, in any CRS; limits capture, map
    and accuracy; a hole is a no-go zone. Needs a [pose] or a georeferenced scene"""
    plots: Text | None = stated(None, example="plots.gpkg:plots", group=SCENE)
    """Plots, likewise; the receipt has area, classes and confidence of each"""
    plots_name: Text | None = stated(None, example="name")
    """Attribute with the plot names; default: name, plot, id, label or the like"""
    seconds: float | None = stated(None, unit="s", ge=0.1, le=1e6, example=30.0, group=TIME)
    """Time budget of the capture; selects the uniform scan or the two passes with the highest expected mIoU"""
    budget: Budget | None = stated(None, example=0.5, group=TIME)
    """Time budget of a two-pass survey, as a fraction of the full scan's time: every 4th line first, then lines chosen
    by the policy"""
    zoom: Literal["auto", "never", "always"] = stated(AUTO, group=TIME)
    """Two-pass survey: every 4th or 8th line first, then the lines of highest expected gain; auto: with --seconds, for
    fields of eight swaths or more, if the weights' table of scans expects as much as of a uniform scan"""
    scan_step: int | None = stated(None, unit="px", ge=1, le=MOST_STEP, example=2)
    """Line spacing of the uniform scan; with --zoom always that of the first pass"""
    scan_exposure_ms: float | None = stated(None, unit="ms", ge=0.5, le=10_000, example=25.0)
    """Exposure of the uniform scan, or of the first pass; default: the camera's, or optimised"""
    extent: Extent = stated(WHOLE)
    """Extent of a uniform scan: whole; part (lines of the highest expected gain; needs --seconds and a prior map;
    default with --seconds and a stated --prior); or lines as SWEEP:FIRST-STOP, such as 0:12-310,1:0-40"""
    max_age: float | None = stated(None, unit="d", ge=0.04, le=3660, example=14.0)
    """With --extent part: maximum age of any place in the prior map; older places are captured first"""
    macs: Compute | None = stated(None, example="50%", group=TIME)
    """MAC budget, as a fraction of full-resolution inference (50%) or as a number (4e9), beside the fusion of a prior
    map; patches with the highest expected gain come first, the rest is the overview"""
    expected_loss: float = stated(0.3, unit="points", ge=0, le=100)
    """Accepted mIoU loss by reading only a part of the patches at full resolution; 0 reads all patches"""
    policy: Policy = stated("gain")
    """Policy that ranks patches, for the second pass or --macs"""
    mask: Text | None = stated(None, example="mask.png")
    """Image of patches to capture again, or to read, for policy mask"""
    weights: Text | None = stated(None, example="weights.safetensors", group=TIME)
    """Model weights (.safetensors); farm: the built-in weights, the default for built-in scenes"""
    accuracy: bool = stated(True)
    """Compute the accuracy if there are labels"""
    controls: bool = stated(False)
    """Also simulate and judge the best uniform scan of the same seconds"""
    effects: Effects = stated(AUTO)
    """Effects of the simulated rig: auto (those that exceed tol), all, none, or names:
    rotation,slit,smear,vignetting,shot,read-noise"""
    tol: Limit = stated(Tolerance(), example=Tolerance().value)
    """Maximum simulation error from omitted effects: in noise sigmas (0.1) or DN (0.5dn); 0: exact; inf: no limit"""
    resampling: Kernel = stated("catmull-rom")
    """Resampling kernel; nearest does not mix spectra"""
    pointing_px: float = stated(0.0, unit="px", ge=0, le=300)
    """Maximum pointing error of the mirror; above 0 sweeps overlap and are registered"""
    out: Text = stated("archive", group=OUTPUT)
    """Folder of the archive"""
    keep: Literal["signal", "raw"] = stated("signal", group=OUTPUT)
    """Captured data to keep: signal (raw lines are deleted once the compressed signal is verified), or raw"""
    until: Literal["capture", "mosaic"] | None = stated(None, example="capture", group=OUTPUT)
    """Stop when this stage is stored: capture (all lines) or mosaic; the same survey without it continues, also on
    another machine with a copy of the archive"""
    engine: Literal["prefect", "plain"] = stated("prefect")
    """Workflow engine; plain runs without a server"""
    memory: Memory = stated(4 * 1024**3, example="4GiB", group=MACHINE)
    """Memory limit for tiles and regions"""
    workers: int | None = stated(None, ge=1, le=1024, example=2, group=MACHINE)
    """Number of workers; default: one per core"""
    scheduler: Scheduler = stated("threads")
    """Worker pool: threads, processes, or the address of a dask scheduler, tcp://host:port"""
    bucket: Text | None = stated(None, example="s3://bucket/prefix")
    """Bucket by which workers of a dask scheduler get stores that they lack"""
    device: Device = stated(PROCESSOR, group=MACHINE)
    """Device of the network; auto: cuda or mps if available, else cpu. Maps of different devices may differ by
    rounding"""
    camera: LineCamera = LineCamera()
    """Line camera."""
    optics: Optics = Optics()
    """Optics of the simulated rig. No value was measured on a unit."""
    mirror: MirrorMotion = MirrorMotion()
    """Dynamics of the simulated mirror."""
    detector: Detector = Detector()
    """Faults of the simulated detector, beyond the camera's gain and noise."""
    air: Air = Air()
    """Air between rig and scene. Without a distance, the scene is light at the aperture."""
    sky: Sky = Sky()
    """Illumination. Without a start time, the sun does not move; its course is that at the [pose]."""
    signal: SignalChoice = SignalChoice()
    """Spectral compression."""
    cost: CostModel = CostModel()
    """Time model of captures."""
    rig: SurveyRig = SurveyRig()
    """Hardware, for source = "rig". The drivers follow the documented protocols and are tested against scripted bytes,
    never on hardware: verify values marked assumed, and record it in provenance. The scene is then the reference for
    accuracy, or "field" with name, size and wavelengths."""
    pose: RigPose | None = None
    """Pose of the rig; adds a map on the ground with the area of each class."""

    @model_validator(mode="wrap")
    @classmethod
    def _in_one_sentence(cls, table: Any, read: ModelWrapValidatorHandler[Self], info: ValidationInfo) -> Self:
        """Complete a table of settings and read it; the first mistake is one sentence that names its flag or file.

        The context is the origin of each key: ``flag`` or the name of a file. The source ``auto`` is resolved, so that
        receipts name the actual source.
        """
        if not isinstance(table, Mapping):
            return read(table)
        origin = info.context
        if origin is None:  # of a server or of Python
            table, origin = _over_file(table)
        table = known_only(table, cls, origin)
        try:
            found = read(with_source(table) if origin is STORED else completed(table))
        except ValidationError as error:
            raise sentence_of(error, cls, origin) from None
        for wrong in mistakes(found, origin):
            raise SettingsError(wrong)
        found.model_fields_set.intersection_update(table)  # others follow from these
        return found

    @model_serializer(mode="wrap")
    def _changed_only(self, write: SerializerFunctionWrapHandler, info: SerializationInfo) -> dict[str, Any]:
        """Return all values; for a server those that a user would state, with absolute paths."""
        tables = declared(type(self))
        table = {
            name: {key: value[key] for key in tables[name] if key in value} if name in tables and value else value
            for name, value in write(self).items()
        }
        return table if info.context is STORED else nested(to_state(anchor_paths(table, Path.cwd())))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for the receipt, without the password and without parameters of models."""
        return self.model_dump(mode="json", context=STORED)

    def but(self, **changes: object) -> Self:
        """Return the settings with other values, which are not checked."""
        assert changes.keys() <= type(self).model_fields.keys()
        return self.model_copy(update=changes)

    @property
    def plain(self) -> bool:
        """Return whether the field is captured in one pass: by a uniform scan, or as a raster."""
        return self.is_map or (
            not self.zooms and (self.as_taken or self.seconds is not None or self.scan_step is not None)
        )

    @property
    def as_taken(self) -> bool:
        """Return whether every line of a recording is used as it was taken: no scan or budget is requested."""
        free = self.budget is None and self.seconds is None and self.scan_step is None
        return self.source == RECORDED and self.zoom != ALWAYS and free

    @property
    def zooms(self) -> bool:
        """Return whether the field is captured in two passes."""
        return not self.is_map and (self.budget is not None or self.zoom == ALWAYS)

    @property
    def may_zoom(self) -> bool:
        """Return whether the planner may choose two passes: a time budget is the only limit of the capture."""
        free = self.seconds is not None and self.macs is None and self.scan_step is None
        whole = self.extent == WHOLE and not self.pointing_px
        return self.zoom == AUTO and free and whole and self.source in (SIM, RIG)

    @property
    def is_map(self) -> bool:
        """Return whether the scene is a raster whose pixels are used as they are, without a camera."""
        return self.source == RASTER

    @property
    def ends_unread(self) -> bool:
        """Return whether a survey without weights ends before a network reads its mosaic."""
        without = self.weights is None and self.scene not in BUILT_IN_SCENES
        return without and self.until is not None and self.plain and self.seconds is None

    @property
    def on_hardware(self) -> bool:
        """Return whether a rig captures, of which no other survey may use the mirror meanwhile."""
        return self.source == RIG and self.rig.mirror_driver != FAKE

    @property
    def shape(self) -> tuple[int, int] | None:
        """Return (y, x) of the built-in scene [px]; None for its default."""
        return None if self.size is None else (self.size[1], self.size[0])

    @property
    def law(self) -> str:
        """Return the law of the built-in scene; empty for other scenes."""
        return LAWS.get(self.scene, "")

    @property
    def moment(self) -> tuple[int, float] | None:
        """Return day of the year and true solar time [h] of a built-in scene; None for other scenes."""
        if self.scene not in BUILT_IN_SCENES:
            return None
        return USUAL_DAY if self.day is None else self.day, USUAL_HOUR if self.hour is None else self.hour

    @property
    def simulated_rig(self) -> Rig:
        """Return the model of the rig for the simulator, with the sun's course at the pose, if there is one."""
        sky = self.sky
        if self.pose is not None:
            sky = replace(sky, latitude_deg=self.pose.lat_deg, longitude_deg=self.pose.lon_deg)
        return Rig(self.camera, self.optics, self.mirror, self.detector, self.air, sky)


def load_settings(
    path: str | Path | None = None,
    flags: Mapping[str, object] | None = None,
    *,
    usual: Callable[[Mapping[str, Any]], Mapping[str, Any]] = lambda stated: {},
) -> Settings:
    """Return the checked settings of a TOML file (None: no file) and of flags, which override it.

    Relative paths in the file start at its folder, those of flags at the current one. Flags have the keys of the file,
    with ``camera.exposure_ms`` for a key in a table; a value None is ignored. ``usual`` gives other defaults for what
    is stated.

    Raises SettingsError, BudgetError: the first key that is not allowed, with its place and the allowed values.
    """
    table, origin = read_file(path)
    given = {key: value for key, value in (flags or {}).items() if value is not None}
    stated = merged(table, nested(given))
    return _checked(merged(usual(stated), stated), origin | dict.fromkeys(given, FLAG))


def parse_settings(table: Mapping[str, object]) -> Settings:
    """Return the settings of a receipt; nothing is completed. Raises SettingsError: a value is not allowed."""
    return _checked(table, STORED)


def to_state(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a whole table that a user would state to get it, by keys such as ``camera.samples``.

    They differ from the defaults, or from what would follow from the others.
    """
    usual, every = unnested(Settings().to_dict()), unnested(table)
    found = {key: one for key, one in every.items() if one is not None and one != usual.get(key) and key != "source"}
    filled = usual | completed(nested(found))
    kept = [key for key in ("source", "scene", "extent", "budget") if every.get(key) not in (None, filled[key])]
    return {key: every[key] for key in (*found, *kept)}


def _checked(table: Mapping[str, object], origin: Mapping[str, str]) -> Settings:
    try:
        return Settings.model_validate(table, context=origin)
    except ValidationError as error:
        raise error.errors()[0]["ctx"]["error"] from None


def _over_file(table: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the parameters of a run over those of its settings file, and the file of each key."""
    rig = table.get("rig")
    if isinstance(rig, Mapping) and rig.get("password") is not None:
        raise SettingsError(
            "rig.password is not allowed as a parameter, since a server stores it; write it into settings_file"
        )
    file = table.get("settings_file") or None  # a form sends empty text
    if not isinstance(file, str | Path | None):
        raise SettingsError(f"settings_file must be the path of a TOML file, got {file!r}")
    below, origin = read_file(file)
    stated = {key: one for key, one in unnested(table).items() if one is not None and key != "settings_file"}
    return merged(below, nested(stated)), origin | dict.fromkeys(stated, "")
