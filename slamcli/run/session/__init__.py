"""The session of a command: executor, progress and interruption."""
