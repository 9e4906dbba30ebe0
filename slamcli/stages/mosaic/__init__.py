"""The mosaic: every frame resampled a second time, from its final pose, into tiles of the map.

The map is an unbounded raster of tiles. A tile is a pure function of the frames that see it, so
tiles can be painted in any order, on any thread or machine, and only those that were seen exist.
"""
