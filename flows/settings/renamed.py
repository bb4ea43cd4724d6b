"""Old names of settings and flags. An error for an old name gives the present one."""

RENAMED = {
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
    "darkest_ms": "min_exposure_ms",
    "remember": "train_temporal",
    "shares": "fractions",
}
