"""Work with a rig and an archive: verbs of the command line, surveys, what they publish, schedules."""
