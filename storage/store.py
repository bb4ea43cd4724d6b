"""Names of the archive in one place."""

from spectralzoom.storage.archive.archive import Archive
from spectralzoom.storage.archive.keys import StageRef as Ref
from spectralzoom.storage.archive.keys import array_digest
from spectralzoom.storage.archive.manifests import check_files, read_table, write_table
from spectralzoom.storage.archive.whole_files import to_json

__all__ = ["Archive", "Ref", "array_digest", "check_files", "read_table", "to_json", "write_table"]
