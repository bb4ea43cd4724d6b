"""Emulators of the rig's devices: the same bytes as the documented protocols, over a pty, a socket or in process."""
