"""Maps as pictures on the disk: tiles, PNG, GeoTIFF, Deep Zoom, and where they lie."""
