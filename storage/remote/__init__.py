"""Archives in a bucket, with a working copy on this machine."""
