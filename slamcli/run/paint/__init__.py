"""The second pass of a map: frames painted from their final poses, and written."""
