"""Everything on disk: the archive and its stages, Zarr layouts, the line spool, scene files and data sets."""
