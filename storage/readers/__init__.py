"""What people bring: scenes and cubes of any format, their labels and settings, with what a file says of itself."""
