"""The line camera: its control socket, its files over FTP, what is in them, and its driver."""
