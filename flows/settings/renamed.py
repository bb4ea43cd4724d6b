"""Names that settings and flags had before, with those that they have now: a message says them."""

SETTINGS = {
    "look": "extent",
    "refresh": "max_age",
    "doubt": "skip_below_error",
    "compute": "macs",
    "kernel": "resampling",
    "rig.panel": "rig.white_reference",
    "optics.stray_share": "optics.stray_fraction",
    "detector.response_share": "detector.prnu_std",
    "detector.stripe_share": "detector.striping_std",
    "detector.dead_share": "detector.dead_fraction",
    "detector.hot_share": "detector.hot_fraction",
    "detector.well_e": "detector.full_well_e",
    "air.airlight_share": "air.airlight_fraction",
    "sky.cloud_share": "sky.cloud_fraction",
}
OF_TRAINING = {"darkest-ms": "min-exposure-ms", "familiar": "fit-ood", "remember": "train-temporal"}
FLAGS = {old.replace("_", "-"): new.replace("_", "-") for old, new in SETTINGS.items()} | OF_TRAINING
