"""The map's picture: every frame painted once more, from where its final pose says it stood.

The map is an endless raster of tiles. A tile is a pure function of the frames that see it, so tiles
can be painted in any order, on any thread or machine, and only those that were seen exist.
"""
