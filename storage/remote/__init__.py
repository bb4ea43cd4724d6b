"""Archives in a bucket: the same stores and keys, worked on in a folder of this machine."""
