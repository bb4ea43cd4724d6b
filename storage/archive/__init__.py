"""The archive: keys, manifests, staging, runs, lineage and the ledger of due runs."""
