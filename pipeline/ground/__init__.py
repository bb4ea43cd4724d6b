"""The ground under a posed rig: scene to metres, to map coordinates, and the map's pixels."""
