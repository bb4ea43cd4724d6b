"""What a map is turned into for those who use it: spectral indices, regions, prescriptions, areas."""
