"""What a survey is opened from and computed by: scenes, sources, zones, prior maps, lines, patches, the model."""
