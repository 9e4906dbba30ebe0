"""A world to test in: floors without end, a camera that does not alias, a drive with its truth."""
