"""The archive: keys, manifests, staging, runs and lineage."""
