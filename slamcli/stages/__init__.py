"""The algorithms: arrays in, records out; strangers to one another, they meet in the mapper."""
