"""Everything on disk: the archive and its stages, Zarr layouts, the line spool, what people bring (``readers``)."""
