"""Emulators of the rig's devices: the same bytes as the documented protocols, over a pty, a socket or in process.

:mod:`~pipeline.rig.emulator.mirror_device` is the mirror controller's state, bytes in and bytes out;
:mod:`~pipeline.rig.emulator.mirror_motion` how its axes move; :mod:`~pipeline.rig.emulator.pty_port` and
:mod:`~pipeline.rig.emulator.in_process` carry its bytes; :mod:`~pipeline.rig.emulator.faults` goes wrong on request.
"""
