"""Files with many frames, each read as a list of parts."""
