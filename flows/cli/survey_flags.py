"""The flags that name a survey's settings, for every verb that takes one: each is text, which the settings check."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from cyclopts import Parameter

IN_TABLES = {"exposure_ms": "camera.exposure_ms"}  # flags of what a settings file has in a table


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SurveyFlags:
    """What was given of a survey's settings; None where nothing was."""

    name: str | None = None
    """What the field is called; as its scene by default."""
    visit: str | None = None
    """Which look at the field, in any words: another one is captured anew, the same one is gone on with."""
    scene: str | None = None
    """`farm` (built in; `farm@2`), or an image or cube file: PNG, JPEG, GeoTIFF, .npy, .npz, .mat, ENVI,
    Zarr."""
    labels: str | None = None
    """File of class colours or numbers on the scene's pixels; accuracy is reported then."""
    bands: str | None = None
    """Bands of the file (or of the farm's 270) to use, from 0: 0,1"""
    wavelengths: str | None = None
    """Their centre wavelengths [nm]: 660,800"""
    source: str | None = None
    """`sim`, the simulated rig (default), or `rig`, the one that the settings' table [rig] names."""
    out: str | None = None
    """Archive: a folder, or s3://bucket/prefix; `archive` by default."""
    budget: str | None = None
    """Seconds of coarse and fine capture over those of the full scan, above 0 and at most 1; 0.5 by default."""
    policy: str | None = None
    """Where to look twice: gain (default), entropy, margin, sobel, saliency, spectral-residual, random, stratified,
    centre, uniform, mask, vgg-static, vgg-trained or self-attention."""
    mask: str | None = None
    """Image of where to look twice, for the policy mask."""
    vgg: str | None = None
    """Weights of VGG19, for the policies vgg-static and vgg-trained."""
    weights: str | None = None
    """Model weights (.safetensors); those for `farm` are built in."""
    threshold: str | None = None
    """Least gain that a second of the fine pass is spent for [nat per px, summed over seats], as the receipt's
    score_per_second; none by default. For the policies gain and entropy."""
    seed: str | None = None
    """Of the scene `farm` and of all noise; 0 by default."""
    effects: str | None = None
    """Of the simulated rig: auto (default: those that change a number by more than --tol), all, none, or names with
    commas: rotation,slit,smear,vignetting,shot,read-noise"""
    tol: str | None = None
    """What leaving effects out may change any number by: in sigmas of its noise, 0.1 by default, or in DN, 0.5dn. With
    0 everything is computed exactly, with inf all is left out that can be."""
    accuracy: bool | None = None
    """Judge the map by the labels once it is published; without it, `evaluate ARCHIVE RUN` does so later."""
    controls: bool | None = None
    """Also judge other placements of the same number of seats (needs labels)."""
    engine: str | None = None
    """`prefect` (default), or `plain` where no server can start."""
    memory: str | None = None
    """How much the work on tiles and regions of the field may take: 4GiB by default."""
    scheduler: str | None = None
    """Who does that work: `threads` (default), `processes`, or a dask scheduler elsewhere, tcp://host:port"""
    workers: str | None = None
    """Tiles, regions or blocks of simulated lines at a time; one a core by default."""
    kernel: str | None = None
    """How lines are read between samples: catmull-rom (default), bilinear, or nearest, which mixes no spectra."""
    pointing_px: str | None = None
    """How far off the mirror may point [px]; above 0 sweeps overlap by more and their seams are registered."""
    size: str | None = None
    """Of the scene `farm`, width x height [px]: 1280x1024 by default."""
    day: str | None = None
    """Of the year, 1 to 366, for the scene `farm`: 172 by default."""
    hour: str | None = None
    """True solar time [h], for the scene `farm`: 11 by default; the sun stands in the south at 12."""
    exposure_ms: str | None = None
    """Exposure of a line [ms]; 100 by default."""

    def by_setting(self) -> dict[str, object]:
        """Values by the settings that they are of, as `flows.settings.survey_settings.load_settings` takes them."""
        return {IN_TABLES.get(name, name): value for name, value in asdict(self).items()}
