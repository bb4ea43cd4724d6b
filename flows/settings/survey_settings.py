"""Settings of a survey, each declared once: type, default, range, unit and one line of help.

`flows.settings.load` reads them; the example file, the flags and the table of the documents are made from this.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Annotated, Any, Literal, cast

from pydantic import PlainValidator

from flows.settings.values import (
    UNKNOWN_AUTO,
    UNKNOWN_OFF,
    Bands,
    Budget,
    Bytes,
    Compute,
    Effects,
    ExpectedError,
    Extent,
    Goal,
    Keep,
    Memory,
    Name,
    Refresh,
    SceneName,
    Scheduler,
    Size,
    Tolerance,
    Unknown,
    VisitName,
    Wavelengths,
    parse_tolerance,
)
from models.network.machine import PROCESSOR, Device
from models.policies.policies import Policy
from models.reading.ood import RATE
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from pipeline.ground.view import RigPose
from pipeline.rectify.kernels import Kernel
from pipeline.rig.device_settings import SurveyRig
from pipeline.setting_fields import stated
from pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Rig, Sky
from pipeline.simulator.scenes.built_in import BUILT_IN_NAMES
from pipeline.simulator.scenes.farm.farm_scene import FARM_SHAPE, USUAL_DAY, USUAL_HOUR
from storage.parallel.pool import WorkerPool

BUILT_IN_SCENES = BUILT_IN_NAMES
USUAL_SIZE = f"{FARM_SHAPE[1]}x{FARM_SHAPE[0]}"
RIG_FIELD = "field"  # the scene of which only the rig, or a recording, knows more than size and bands
OF_THE_MACHINE = ("scheduler", "workers", "device")  # what of that day need not be there today
OF_A_PART = ("max_age", "skip_below_error")  # of what a field that is remembered is looked at by
OF_RECORDINGS = ("sweeps", "pointing", "dark", "white", "scan")
USUAL_BUDGET = 0.5  # of a zoomed survey
MOST_STEP = 8  # pixels from line to line of a uniform scan
UNIFORM = ("seconds", "bytes_raw", "goal", "scan_step", "scan")  # settings of which one asks for a uniform scan
SPARING = ("macs", "least_gain")  # by which a uniform scan is read in detail in part
OF_TWO_PASSES = ("budget", "coarse_exposure_ms", "policy", "mask")  # and of which none may
OF_CHOOSING = ("policy", "mask")  # but for these where a part of the scan is chosen
PATHS = (
    *("scene", "labels", "sweeps", "pointing", "dark", "white", "out", "mask", "weights"),
    *("zones.area", "zones.no_go", "zones.plots"),
)
ALWAYS: Literal["always"] = "always"  # a first pass, and lines between where they promise most
AUTO, SIM, RIG, RASTER = "auto", "sim", "rig", "raster"  # where pixels come from
RECORDED = "recorded"  # likewise, and the uniform scan that takes a recording's own lines
# of a camera alone: tables, and settings beside them
OF_A_CAMERA = (
    *("camera", "optics", "mirror", "detector", "air", "sky", "cost", "rig", *UNIFORM, "scan_exposure_ms"),
    *("coarse_exposure_ms", "budget", "zoom", "effects", "tol", "resampling", "pointing_px", "extent", *OF_A_PART),
)
OF_A_VIEW = ("camera.pitch_um", "camera.focal_length_mm")  # how large a pixel is seen, which a [pose] asks for
ALL_OF_IT = "leave it out to read all of the scan in detail"
INSTEAD = "leave it out to zoom by --budget"
WORKERS = "one process or thread each; leave it out for one a core"
EPSG = "the number after EPSG:, such as 32632"


@dataclass(frozen=True)
class MapChoice:
    """Choice of the map of a posed survey; None leaves it to the pose."""

    epsg: int | None = stated(
        None, "Projected CRS in metres; the rig's UTM zone by default", "", 1024, 32_767, example=32632, why=EPSG
    )
    resolution_m: float | None = stated(
        None, "By default the median footprint of a pixel", "m", 1e-4, 1000, example=0.12
    )


@dataclass(frozen=True)
class SignalChoice:
    """Choice of what is kept of spectra: scores of the components that rise above the noise."""

    step: float = stated(1.0, "Step in which scores are rounded, in standard deviations of the noise", "", 0.01, 10)
    false_alarm: float = stated(
        0.01, "Probability that noise alone gives a component, by a test over the whole field", "", 1e-6, 0.2
    )
    rare_spectra: float = stated(
        1.0, "Spectra of a sweep that noise alone may mark as rare; rare ones keep what components leave", "", 1e-6, 1e6
    )
    least: int = stated(4, "Components that are kept at any rate", "", 1, 270)


@dataclass(frozen=True)
class ZoneChoice:
    """Files of polygons that a survey keeps to, or tells of."""

    area: str | None = stated(
        None,
        "Area of interest, polygons as GeoJSON, GeoPackage (FILE.gpkg:LAYER) or shapefile: lines, scores, map, accuracy"
        " and areas keep to it",
        example="area.geojson",
    )
    no_go: str | None = stated(
        None, "Zones that are left out: no detail is asked for there, and no map drawn", example="no_go.geojson"
    )
    plots: str | None = stated(
        None, "Plots with names: the receipt has area, classes and confidence of each", example="plots.gpkg:plots"
    )
    plots_name: str | None = stated(
        None, "Attribute that names the plots; name, plot, plot_id, id or label by default", example="name"
    )


def source_of(scene: str) -> str:
    """Return where the pixels of a scene come from by default; see the setting ``source``."""
    if scene == RIG_FIELD:
        return RIG
    return SIM if scene in BUILT_IN_SCENES else RASTER


def table(about: str, make: type[Any] | None) -> Any:
    """A table of settings that stand for a part of the rig or of the map; None where there is none by default."""
    metadata = {"description": about}
    return field(default=None, metadata=metadata) if make is None else field(default_factory=make, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """All that one survey needs to know. Made by `load_settings` or `parse_settings`: they check; this does not.

    The source ``auto`` becomes what it stands for, so that receipts hold that.
    """

    name: Name | None = stated(None, "What the field is called; as its scene by default", example="north")
    visit: VisitName | None = stated(
        None,
        "Which look at the field, by its date (2026-06-01) or in any words: another one is captured anew, the same one"
        " gone on with",
        example="first of June",
    )
    prior: str = stated(
        "auto",
        "What of the field is remembered: latest (what its newest run left), the name of a run, or none; auto is latest"
        " for surveys that are served, else none",
    )
    extent: Extent = stated(
        "whole",
        "What a uniform scan looks at: whole (the field), part (with --seconds, of a field that is remembered: the "
        "lines that promise most there; what --prior and --seconds ask for together), or lines by hand, as a receipt "
        "tells them: 0:12-310,1:0-40",
    )
    max_age: Refresh | None = stated(
        None,
        "With --extent part: how old what is remembered of any place may become, such as 14d or 36h; what would be "
        "older is looked at before all else",
        "d",
        example="14d",
    )
    skip_below_error: ExpectedError | None = stated(
        None,
        "With --extent part: look at nothing, and leave the map as it is, where less than this fraction of what is "
        "remembered is expected to be wrong, and nothing is too old",
        example="2%",
    )
    scene: SceneName = stated(
        "farm",
        "`farm` or `scouting` (built in; `farm@2`, `scouting@1`), or a file: PNG, JPEG, BMP, GeoTIFF, .npy, .npz,"
        " .mat, ENVI, Zarr; as source raster also a folder or a glob of georeferenced tiles; a pattern that each visit"
        " fills in, {date:%Y-%m-%d}.tif or {new}.tif (the newest that was not surveyed)",
    )
    labels: str | None = stated(
        None, "Class colours or numbers on the scene's pixels; accuracy is reported then", example="labels.png"
    )
    bands: Bands | None = stated(None, "Bands of the file (or of the farm's 270) to use, from 0: 0,1", example=(0, 1))
    wavelengths: Wavelengths | None = stated(None, "Their centre wavelengths: 660,800", "nm", example=(660.0, 800.0))
    source: Literal["auto", "sim", "rig", "raster", "recorded"] = stated(
        "auto",
        "Where pixels come from: sim (the simulated rig looks at the scene), rig (the one that the table [rig] names), "
        "raster (the file is a map already: its pixels are taken as they are), recorded (the sweeps of --sweeps); auto "
        "is recorded where there are sweeps, raster for files, sim for built-in scenes, rig for the scene `field`",
    )
    sweeps: str | None = stated(
        None,
        "Recorded sweeps: an archive, ARCHIVE/runs/NAME or s3://bucket/prefix, a folder of ENVI cubes or of a Headwall"
        " camera, one ENVI or Zarr cube",
        example="sweeps",
    )
    pointing: str | None = stated(
        None,
        "Where their lines looked: a table with a row a line (CSV, Parquet), a TOML file of a vector that the mirror "
        "played, or a folder with one for each cube; NAME.pointing.csv beside a cube NAME by default",
        example="pointing.csv",
    )
    dark: str | None = stated(
        None, "Their dark frame, ENVI or .npy; NAME.dark.hdr or dark*.hdr beside them by default", example="dark.hdr"
    )
    white: str | None = stated(
        None, "Their white frame, likewise; NAME.white.hdr or white*.hdr by default", example="white.hdr"
    )
    scan: Literal["recorded"] | None = stated(
        None,
        "One uniform scan of a recording's own lines, each as it was taken; of a recording the default where no budget "
        "and no other scan is asked for",
        example="recorded",
    )
    out: str = stated("archive", "Archive: a folder, or s3://bucket/prefix")
    keep: Keep = stated(
        "signal",
        "What stays of captured lines: signal (raw lines are cleared away once each was compared with what was "
        "condensed from it), raw (they stay too), or for how long they stay: raw 7d",
    )
    kept_bytes: Bytes | None = stated(
        None,
        "What the scores of a uniform scan's lines and mosaic may take, most of what a run keeps: they are rounded in "
        "coarser steps than [signal] says where they take more",
        example="8MB",
        why="leave it out for steps of the noise",
    )
    budget: Budget | None = stated(
        None,
        "Zoom within this fraction of the full scan's seconds, in the camera's exposure and by the policy: every 4th "
        "line first, then lines between where the policy says",
        example=0.5,
    )
    zoom: Literal["never", "always"] = stated(
        "never",
        "Capture every 4th or 8th line first, then the lines between where they promise most in the seconds that are "
        "left: always, or never (one uniform scan, which scored more in the same seconds where both were measured)",
    )
    seconds: float | None = stated(
        None,
        "The camera's seconds that the capture may take: one uniform scan, the one whose map is likely to score most "
        "by the weights' record, or with zoom a first pass and lines between",
        "s",
        0.1,
        1e6,
        example=30.0,
        why=INSTEAD,
    )
    bytes_raw: Bytes | None = stated(None, "The same with no more raw data than this", example="2GiB", why=INSTEAD)
    goal: Goal | None = stated(
        None,
        "One uniform scan: the cheapest whose map is likely to have this mIoU in percent, or IoU of classes: "
        "92,weed=70",
        example="92",
        why=INSTEAD,
    )
    scan_step: int | None = stated(
        None,
        "One uniform scan with lines so far apart, chosen by hand; with zoom the lines of the first pass",
        "px",
        1,
        MOST_STEP,
        example=2,
        why=INSTEAD,
    )
    scan_exposure_ms: float | None = stated(
        None, "Exposure of that scan's lines; by default the camera's", "ms", 0.5, 10_000, example=25.0, why=INSTEAD
    )
    macs: Compute | None = stated(
        None,
        "Of a uniform scan or a raster read in detail what promises most for so much of the multiply-adds of reading "
        "everything, 25%, or for so many, 4e9; the rest is read from its coarse means",
        example="25%",
        why=ALL_OF_IT,
    )
    least_gain: float | None = stated(
        None,
        "Of a uniform scan or a raster read in detail only patches that promise at least so much, for the "
        "policies gain and entropy",
        "nat per px",
        0,
        100,
        example=0.02,
        why=ALL_OF_IT,
    )
    expected_loss: float = stated(
        0.3,
        "Points of mIoU that reading a part of the patches in full may lose, by the weights' record; 0 reads all of "
        "them, as weights without that record do",
        "points",
        0,
        100,
    )
    coarse_exposure_ms: float | None = stated(
        None,
        "Exposure of the first pass; by default the camera's, or as the record says",
        "ms",
        0.5,
        10_000,
        example=25.0,
    )
    policy: Policy = stated("gain", "Where to capture again")
    mask: str | None = stated(None, "Image of where to capture again, for the policy mask", example="mask.png")
    weights: str | None = stated(
        None,
        "Model weights (.safetensors); those for `farm` are built in: `farm` names them for another source's field",
        example="weights.safetensors",
    )
    unknown: Unknown = stated(
        "auto",
        "Pixels unlike all that the weights were trained on get the class unknown: auto (where the weights know "
        "what is familiar to them, at 0.1%), off, or the fraction of known pixels that may be called unknown: 0.5%",
    )
    seed: int = stated(0, "Seed of a built-in scene and of all noise", "", 0, 2**63 - 1)
    effects: Effects = stated(
        "auto",
        "Effects of the simulated rig: auto (those that change a number by more than tol), all, none, or names with "
        "commas: rotation,slit,smear,vignetting,shot,read-noise",
    )
    tol: Annotated[Tolerance, PlainValidator(parse_tolerance)] = stated(
        Tolerance(),
        "What leaving effects out may change any number by: sigmas of its noise, or 0.5dn in DN; 0 computes all "
        "exactly, inf leaves out all that can be",
        example=Tolerance().value,
    )
    accuracy: bool = stated(
        True, "Judge the published map by the labels; without it, `evaluate ARCHIVE RUN` does so later"
    )
    controls: bool = stated(True, "Also judge other placements of the same number of patches (needs labels)")
    engine: Literal["prefect", "plain"] = stated("prefect", "Who runs the stages; plain where no server can start")
    memory: Memory = stated(4 * 1024**3, "How much the work on tiles and regions of the field may take", example="4GiB")
    scheduler: Scheduler = stated(
        "threads", "Who does that work: threads, processes, or a dask scheduler elsewhere, tcp://host:port"
    )
    workers: int | None = stated(
        None,
        "Tiles, regions or blocks of simulated lines at a time; one a core by default",
        "",
        1,
        1024,
        example=2,
        why=WORKERS,
    )
    device: Device = stated(
        PROCESSOR,
        "Where the network computes; auto is cuda or mps where torch can use one here, else the processor. A map of "
        "another device is another store: it may differ by rounding",
    )
    resampling: Kernel = stated("catmull-rom", "How lines are read between samples; nearest mixes no spectra")
    pointing_px: float = stated(
        0.0, "How far off the mirror may point; above 0 sweeps overlap, seams are registered", "px", 0, 300
    )
    size: Size | None = stated(
        None, f"Size of a built-in scene, width x height; {USUAL_SIZE} by default", "px", example=USUAL_SIZE
    )
    day: int | None = stated(
        None,
        f"Day of the year, for built-in scenes; {USUAL_DAY} by default, the 21st of June",
        "",
        1,
        366,
        example=USUAL_DAY,
    )
    hour: float | None = stated(
        None,
        f"True solar time, for built-in scenes; {USUAL_HOUR:g} by default, noon is 12",
        "h",
        0,
        24,
        example=USUAL_HOUR,
    )
    interest: float | None = stated(
        None,
        "Share of the scene `scouting` in patches of weeds, bare ground, poor growth or lodging; 0.02 to 0.1 by the"
        " seed by default",
        "",
        0,
        1,
        example=0.0625,
    )
    camera: LineCamera = table("The line camera.", LineCamera)
    optics: Optics = table(
        "The simulated rig beyond its camera: nothing of it was measured on a unit. First its optics.", Optics
    )
    mirror: MirrorMotion = table("How the simulated mirror follows its commands, and what coats it.", MirrorMotion)
    detector: Detector = table("What the sensor adds to the camera's own read noise, gain and well.", Detector)
    air: Air = table("Between rig and scene; without a distance the scene is light at the aperture.", Air)
    sky: Sky = table("The light; without a moment the sun stands still.", Sky)
    signal: SignalChoice = table("What of the spectra is kept.", SignalChoice)
    cost: CostModel = table("What captures cost in time.", CostModel)
    rig: SurveyRig = table(
        'The rig, for source = "rig". Written for documented protocols and tested against emulators, never run on '
        "hardware: whatever is called assumed, try it on yours and say so in provenance. The scene is then what "
        'results are judged by, or "field", of which only name, size and wavelengths are given.',
        SurveyRig,
    )
    pose: RigPose | None = table(
        "Where the rig stands: with it the map is also drawn on the ground, with hectares of each class.", None
    )
    map: MapChoice = table("What map to draw on the ground, for a survey with [pose].", MapChoice)
    zones: ZoneChoice = table(
        "Polygons on the field, in any CRS where the survey has a [pose] or a georeferenced scene, else in pixels.",
        ZoneChoice,
    )

    def __post_init__(self) -> None:
        if self.source == AUTO:
            object.__setattr__(self, "source", source_of(self.scene) if self.sweeps is None else RECORDED)

    @property
    def plain(self) -> bool:
        """Return whether a uniform scan is asked for, or a raster: all of the field is there at once."""
        return self.is_map or (not self.zooms and any(getattr(self, name) is not None for name in UNIFORM))

    @property
    def zooms(self) -> bool:
        """Return whether a first pass is asked for, and lines between."""
        return not self.is_map and (self.budget is not None or self.zoom == ALWAYS)

    @property
    def undecided(self) -> bool:
        """True where no setting says how the field is captured: the record of the weights decides."""
        return not self.plain and self.budget is None

    @property
    def is_map(self) -> bool:
        """Return whether the scene is a raster whose pixels are taken as they are: no camera looks at it."""
        return self.source == RASTER

    @property
    def unknown_rate(self) -> float | None:
        """Fraction of known pixels that may be called unknown; None where none is to be."""
        usual = {UNKNOWN_AUTO: RATE, UNKNOWN_OFF: None}
        return usual[self.unknown] if self.unknown in usual else float(self.unknown.removesuffix("%")) / 100

    @property
    def pool(self) -> WorkerPool:
        return WorkerPool(self.scheduler, self.workers)

    @property
    def shape(self) -> tuple[int, int] | None:
        """(y, x) of the built-in scene [px], None for its default."""
        return None if self.size is None else (self.size[1], self.size[0])

    @property
    def moment(self) -> tuple[int, float] | None:
        """Day of the year and true solar time [h] of the built-in scene; None of a scene that has none."""
        if self.scene not in BUILT_IN_SCENES:
            return None
        return USUAL_DAY if self.day is None else self.day, USUAL_HOUR if self.hour is None else self.hour

    @property
    def simulated_rig(self) -> Rig:
        """All that the simulator knows of the rig; SettingsError where its parts do not go together."""
        return Rig(self.camera, self.optics, self.mirror, self.detector, self.air, self.sky)

    def to_dict(self) -> dict[str, object]:
        """Plain values for the receipt, no password; `parse_settings` reads them back to the same settings."""
        plain = {key: plain_value(value) for key, value in (asdict(self) | {"tol": str(self.tol)}).items()}
        cast("dict[str, object]", plain["rig"]).pop("password")  # receipts are passed on
        return plain


def plain_value(value: object) -> object:
    """A value of the settings as JSON knows it: lists, and text for a moment."""
    if isinstance(value, Mapping):
        return {key: plain_value(item) for key, item in value.items()}
    if isinstance(value, datetime):
        return value.isoformat()
    return list(value) if isinstance(value, tuple) else value
