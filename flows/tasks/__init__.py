"""Parts of a survey below its stages: scenes, sources, zones, prior maps, choice of lines and patches, network."""
