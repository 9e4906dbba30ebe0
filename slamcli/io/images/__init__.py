"""Picture files: their format by content, checks of their headers, decoding, and damage."""
