"""Numeric core: arrays (or a device's bytes) in, arrays out; no files, no Prefect."""
