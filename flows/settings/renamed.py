"""Settings and flags of former names: messages say what they are called now, or what took their place."""

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
OF_TRAINING = {
    "darkest-ms": "min-exposure-ms",
    "familiar": "fit-ood",
    "remember": "train-temporal",
    "shares": "fractions",
    "least-share": "least-fraction",
}
FLAGS = {  # and what to say of each
    **{old.replace("_", "-"): f"it is called --{new.replace('_', '-')} now" for old, new in SETTINGS.items()},
    **{old: f"it is called --{new} now" for old, new in OF_TRAINING.items()},
    "bytes-kept": "patches are no longer stored; --macs says how much is read in detail",
    "late": "Prefect begins a run late rather than never, and cancels one that is due while the field's last still "
    "runs",
    "notify": "Prefect sends notices of failed runs by an automation: prefect automation create --from-file "
    "automation.yaml",
}
