"""Drivers of the real rig: bytes to and from devices. No files, no Prefect, no arrays on disk."""
