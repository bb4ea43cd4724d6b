"""Drivers of the real rig: bytes to and from devices. No Prefect, no arrays on disk."""
