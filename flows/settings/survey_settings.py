"""Define the settings of a survey, each once: type, default, range, unit and one line of help.

`flows.settings.load` reads them. The example file, the flags and the manual's table are made from this module.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Annotated, Any, Literal, cast

from pydantic import PlainValidator

from spectralzoom.flows.settings.values import (
    EXTENT_WHOLE,
    Bands,
    Budget,
    Compute,
    Effects,
    Extent,
    Memory,
    Name,
    Scheduler,
    Size,
    Tolerance,
    VisitName,
    Wavelengths,
    parse_tolerance,
)
from spectralzoom.models.network.machine import PROCESSOR, Device
from spectralzoom.models.policies.policies import Policy
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import CostModel
from spectralzoom.pipeline.ground.view import RigPose
from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rig.device_settings import FAKE, SurveyRig
from spectralzoom.pipeline.setting_fields import stated
from spectralzoom.pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Rig, Sky
from spectralzoom.pipeline.simulator.scenes.built_in import BUILT_IN_NAMES, LAWS
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import FARM_SHAPE, USUAL_DAY, USUAL_HOUR
from spectralzoom.storage.parallel.pool import WorkerPool

BUILT_IN_SCENES = BUILT_IN_NAMES
USUAL_SIZE = f"{FARM_SHAPE[1]}x{FARM_SHAPE[0]}"
RIG_FIELD = "field"  # scene in front of a rig or in a recording: only its size and bands are known
OF_THE_MACHINE = ("scheduler", "workers", "bucket", "device")  # settings that depend on the machine of the survey
OF_RECORDINGS = ("sweeps", "pointing", "dark", "white")
USUAL_BUDGET = 0.5  # of a zoomed survey
MOST_STEP = 8  # greatest line spacing [px]
UNIFORM = ("seconds", "scan_step")  # each of these requests a uniform scan
OF_TWO_PASSES = ("budget", "coarse_exposure_ms", "policy", "mask")  # each of these requests two passes
OF_CHOOSING = ("policy", "mask")  # also valid for a uniform scan with --macs
PATHS = (
    *("scene", "labels", "sweeps", "pointing", "dark", "white", "out", "mask", "weights"),
    *("zones.area", "zones.plots"),
)
ALWAYS: Literal["always"] = "always"  # values of the setting `zoom`
NEVER: Literal["never"] = "never"
AUTO: Literal["auto"] = "auto"  # value of the settings `zoom` and `source`
SIM, RIG, RASTER, RECORDED = "sim", "rig", "raster", "recorded"  # values of the setting `source`
# settings and tables that only a camera has
OF_A_CAMERA = (
    *("camera", "optics", "mirror", "detector", "air", "sky", "cost", "rig", *UNIFORM, "scan_exposure_ms"),
    *("coarse_exposure_ms", "budget", "zoom", "effects", "tol", "resampling", "pointing_px", "extent", "max_age"),
)
OF_A_VIEW = ("camera.pitch_um", "camera.focal_length_mm")  # these give the IFOV, which a [pose] needs


@dataclass(frozen=True)
class SignalChoice:
    """Limits of the spectral compression into components that exceed the noise."""

    step: float = stated(1.0, "Quantisation step of the scores, in standard deviations of the noise", "", 0.01, 10)
    false_alarm: float = stated(0.01, "Probability that noise alone yields a component in a field", "", 1e-6, 0.2)
    rare_spectra: float = stated(
        1.0, "Spectra per sweep that noise alone may mark as rare; rare spectra keep their residuals", "", 1e-6, 1e6
    )
    least: int = stated(4, "Minimum number of components", "", 1, 270)


@dataclass(frozen=True)
class ZoneChoice:
    """Polygon files: area of interest and plots."""

    area: str | None = stated(
        None,
        "Area of interest: polygons as GeoJSON, GeoPackage (FILE.gpkg:LAYER) or shapefile; limits capture, map and"
        " accuracy; a hole is a no-go zone",
        example="area.geojson",
    )
    plots: str | None = stated(
        None, "Plots, same formats; the receipt has area, classes and confidence of each", example="plots.gpkg:plots"
    )
    plots_name: str | None = stated(
        None, "Attribute with the plot names; default: name, plot, id, label or the like", example="name"
    )


def source_of(scene: str) -> str:
    """Return the default of the setting ``source`` for a scene."""
    return RIG if scene == RIG_FIELD else SIM if scene in BUILT_IN_SCENES else RASTER


def table(about: str, make: type[Any] | None) -> Any:
    """Declare a table of settings; it is absent by default where ``make`` is None."""
    metadata = {"description": about}
    return field(default=None, metadata=metadata) if make is None else field(default_factory=make, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """Settings of one survey. `load_settings` and `parse_settings` check them; the constructor does not.

    The source ``auto`` is resolved on construction, so that receipts name the actual source.
    """

    name: Name | None = stated(None, "Field name; default: the scene's", example="north")
    visit: VisitName | None = stated(
        None,
        "Visit: a date as YYYY-MM-DD, or any text. A new visit captures again; the same visit resumes",
        example="first of June",
    )
    prior: str = stated(
        "auto",
        "Prior map of the field: latest (newest run), a run's name, or none; auto: latest under `serve`, else none",
    )
    extent: Extent = stated(
        "whole",
        "Extent of a uniform scan: whole; part (lines of the highest expected gain; needs --seconds and a prior map;"
        " default with --seconds and a stated --prior); or lines as SWEEP:FIRST-STOP, such as 0:12-310,1:0-40",
    )
    max_age: float | None = stated(
        None,
        "With --extent part: maximum age of any place in the prior map; older places are captured first",
        "d",
        0.04,
        3660,
        example=14.0,
    )
    scene: str = stated(
        "farm",
        "Scene: farm, scouting or trial (built in; --seed gives another), or a file: PNG, GeoTIFF, ENVI, Zarr and"
        " others. A folder of tiles, or tiles/*.tif, is one run a tile on the command line."
        " Pattern for repeated visits: {date:%Y-%m-%d}.tif",
    )
    labels: str | None = stated(
        None, "Label image on the scene's pixels (class colours or numbers); enables accuracy", example="labels.png"
    )
    bands: Bands | None = stated(None, "Band numbers to use, counted from 0: 0,1 or 0-3; default: all", example=(0, 1))
    wavelengths: Wavelengths | None = stated(
        None, "Centre wavelengths of these bands: 660,800", "nm", example=(660.0, 800.0)
    )
    source: Literal["auto", "sim", "rig", "raster", "recorded"] = stated(
        "auto",
        "Pixel source: sim (simulated rig), rig (hardware of table [rig]), raster (pixels of the file as they are),"
        " recorded (the sweeps of --sweeps); auto: recorded with --sweeps, raster for files, sim for built-in scenes,"
        " rig for the scene `field`",
    )
    sweeps: str | None = stated(
        None,
        "Recorded sweeps: an archive, ARCHIVE/runs/NAME, a folder of ENVI cubes or of a Headwall"
        " camera, or one ENVI or Zarr cube. Without another scan or budget, every line is used as it was taken",
        example="sweeps",
    )
    pointing: str | None = stated(
        None,
        "Pointing of the recorded lines: a table with one row per line (CSV), or a folder with one table per cube;"
        " default: NAME.pointing.csv beside each cube",
        example="pointing.csv",
    )
    dark: str | None = stated(
        None, "Dark frame of recorded sweeps, ENVI or .npy; default: NAME.dark.hdr or dark*.hdr", example="dark.hdr"
    )
    white: str | None = stated(
        None, "White frame of recorded sweeps, likewise; default: NAME.white.hdr or white*.hdr", example="white.hdr"
    )
    out: str = stated("archive", "Folder of the archive")
    keep: Literal["signal", "raw"] = stated(
        "signal", "Captured data to keep: signal (raw lines are deleted once the compressed signal is verified), or raw"
    )
    until: Literal["capture", "mosaic"] | None = stated(
        None,
        "Stop when this stage is stored: capture (all lines) or mosaic; the same survey without it"
        " continues, also on another machine with a copy of the archive",
        example="capture",
    )
    budget: Budget | None = stated(
        None,
        "Time budget of a two-pass survey, as a fraction of the full scan's time: every 4th line first, then lines"
        " chosen by the policy",
        example=0.5,
    )
    zoom: Literal["auto", "never", "always"] = stated(
        AUTO,
        "Two-pass survey: every 4th or 8th line first, then the lines of highest expected gain; auto: with --seconds,"
        " for fields of eight swaths or more, if the weights' table of scans expects as much as of a uniform scan",
    )
    seconds: float | None = stated(
        None,
        "Time budget of the capture; selects the uniform scan or the two passes with the highest expected mIoU",
        "s",
        0.1,
        1e6,
        example=30.0,
    )
    scan_step: int | None = stated(
        None,
        "Line spacing of the uniform scan; with --zoom always that of the first pass",
        "px",
        1,
        MOST_STEP,
        example=2,
    )
    scan_exposure_ms: float | None = stated(
        None, "Exposure of the uniform scan; default: the camera's", "ms", 0.5, 10_000, example=25.0
    )
    macs: Compute | None = stated(
        None,
        "MAC budget, as a fraction of full-resolution inference (50%) or as a number (4e9), beside the fusion of a"
        " prior map; patches with the highest expected gain come first, the rest is the overview",
        example="50%",
    )
    expected_loss: float = stated(
        0.3,
        "Accepted mIoU loss by reading only a part of the patches at full resolution; 0 reads all patches",
        "points",
        0,
        100,
    )
    coarse_exposure_ms: float | None = stated(
        None, "Exposure of the first pass; default: the camera's, or optimised", "ms", 0.5, 10_000, example=25.0
    )
    policy: Policy = stated("gain", "Policy that ranks patches, for the second pass or --macs")
    mask: str | None = stated(
        None, "Image of patches to capture again, or to read, for policy mask", example="mask.png"
    )
    weights: str | None = stated(
        None,
        "Model weights (.safetensors); farm: the built-in weights, the default for built-in scenes",
        example="weights.safetensors",
    )
    seed: int = stated(0, "Random seed of built-in scenes and of all noise", "", 0, 2**63 - 1)
    effects: Effects = stated(
        "auto",
        "Effects of the simulated rig: auto (those that exceed tol), all, none, or names:"
        " rotation,slit,smear,vignetting,shot,read-noise",
    )
    tol: Annotated[Tolerance, PlainValidator(parse_tolerance)] = stated(
        Tolerance(),
        "Maximum simulation error from omitted effects: in noise sigmas (0.1) or DN (0.5dn); 0: exact; inf: no limit",
        example=Tolerance().value,
    )
    accuracy: bool = stated(True, "Compute the accuracy if there are labels")
    controls: bool = stated(False, "Also simulate and judge the best uniform scan of the same seconds")
    engine: Literal["prefect", "plain"] = stated("prefect", "Workflow engine; plain runs without a server")
    memory: Memory = stated(4 * 1024**3, "Memory limit for tiles and regions", example="4GiB")
    scheduler: Scheduler = stated(
        "threads", "Worker pool: threads, processes, or the address of a dask scheduler, tcp://host:port"
    )
    workers: int | None = stated(None, "Number of workers; default: one per core", "", 1, 1024, example=2)
    bucket: str | None = stated(
        None, "Bucket by which workers of a dask scheduler get stores that they lack", example="s3://bucket/prefix"
    )
    device: Device = stated(
        PROCESSOR,
        "Device of the network; auto: cuda or mps if available, else cpu. Maps of different devices may differ by"
        " rounding",
    )
    resampling: Kernel = stated("catmull-rom", "Resampling kernel; nearest does not mix spectra")
    pointing_px: float = stated(
        0.0, "Maximum pointing error of the mirror; above 0 sweeps overlap and are registered", "px", 0, 300
    )
    size: Size | None = stated(
        None, f"Size of a built-in scene, width x height; default: {USUAL_SIZE}", "px", example=USUAL_SIZE
    )
    day: int | None = stated(
        None, f"Day of the year of a built-in scene; default: {USUAL_DAY} (21 June)", "", 1, 366, example=USUAL_DAY
    )
    hour: float | None = stated(
        None, f"True solar time of a built-in scene; default: {USUAL_HOUR:g}", "h", 0, 24, example=USUAL_HOUR
    )
    interest: float | None = stated(
        None,
        "Fraction of the scene scouting with weeds, bare ground, poor growth or lodging; default: 0.02 to 0.1 by seed",
        "",
        0,
        1,
        example=0.0625,
    )
    camera: LineCamera = table("Line camera.", LineCamera)
    optics: Optics = table("Optics of the simulated rig. No value was measured on a unit.", Optics)
    mirror: MirrorMotion = table("Dynamics and coating of the simulated mirror.", MirrorMotion)
    detector: Detector = table(
        "Detector of the simulated rig, beyond the camera's gain, read noise and bits.", Detector
    )
    air: Air = table("Air between rig and scene. Without a distance, the scene is light at the aperture.", Air)
    sky: Sky = table("Illumination. Without a start time, the sun does not move.", Sky)
    signal: SignalChoice = table("Spectral compression.", SignalChoice)
    cost: CostModel = table("Time model of captures.", CostModel)
    rig: SurveyRig = table(
        'Hardware, for source = "rig". The drivers follow the documented protocols and are tested against scripted '
        "bytes, never on hardware: verify values marked assumed, and record it in provenance. The scene is then the "
        'reference for accuracy, or "field" with name, size and wavelengths.',
        SurveyRig,
    )
    pose: RigPose | None = table("Pose of the rig; adds a map on the ground with the area of each class.", None)
    zones: ZoneChoice = table(
        "Polygons on the field, in any CRS; they need a [pose] or a georeferenced scene.", ZoneChoice
    )

    def __post_init__(self) -> None:
        if self.source == AUTO:
            object.__setattr__(self, "source", source_of(self.scene) if self.sweeps is None else RECORDED)

    @property
    def plain(self) -> bool:
        """Return whether the field is captured in one pass: by a uniform scan, or as a raster."""
        return self.is_map or (
            not self.zooms and (self.as_taken or any(getattr(self, name) is not None for name in UNIFORM))
        )

    @property
    def ends_unread(self) -> bool:
        """Return whether a survey without weights ends before a network reads its mosaic."""
        without = self.weights is None and self.scene not in BUILT_IN_SCENES
        return without and self.until is not None and self.plain

    @property
    def as_taken(self) -> bool:
        """Return whether every line of a recording is used as it was taken: no scan or budget is requested."""
        others = (self.budget, *(getattr(self, name) for name in UNIFORM))
        return self.source == RECORDED and self.zoom != ALWAYS and all(one is None for one in others)

    @property
    def zooms(self) -> bool:
        """Return whether the field is captured in two passes."""
        return not self.is_map and (self.budget is not None or self.zoom == ALWAYS)

    @property
    def may_zoom(self) -> bool:
        """Return whether the planner may choose two passes: a time budget is the only limit of the capture."""
        free = self.seconds is not None and self.macs is None and self.scan_step is None
        whole = self.extent == EXTENT_WHOLE and not self.pointing_px
        return self.zoom == AUTO and free and whole and self.source in (SIM, RIG)

    @property
    def is_map(self) -> bool:
        """Return whether the scene is a raster whose pixels are used as they are, without a camera."""
        return self.source == RASTER

    @property
    def on_hardware(self) -> bool:
        """Return whether a rig captures, of which no other survey may use the mirror meanwhile."""
        return self.source == RIG and self.rig.mirror_driver != FAKE

    @property
    def pool(self) -> WorkerPool:
        """Return the worker pool."""
        return WorkerPool(self.scheduler, self.workers, self.bucket)

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
        """Return the model of the rig for the simulator. Raises SettingsError: its parts contradict each other."""
        return Rig(self.camera, self.optics, self.mirror, self.detector, self.air, self.sky)

    def to_dict(self) -> dict[str, object]:
        """Return plain values for the receipt, without the password; `parse_settings` reads them back."""
        plain = {key: plain_value(value) for key, value in (asdict(self) | {"tol": str(self.tol)}).items()}
        cast("dict[str, object]", plain["rig"]).pop("password")  # receipts are shared
        return plain


def plain_value(value: object) -> object:
    """Return a value of the settings as JSON represents it."""
    if isinstance(value, Mapping):
        return {key: plain_value(item) for key, item in value.items()}
    if isinstance(value, datetime):
        return value.isoformat()
    return list(value) if isinstance(value, tuple) else value
