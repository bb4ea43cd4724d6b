"""Signal: raw numbers of the camera to scene values, by what its references say of each element."""
