"""Square detection: a square on the floor in a photo, its corners to a fraction of a pixel.

`candidates` proposes quadrilaterals, `edges` fits their sides to the picture, `search` chooses.
"""

from slamcli.stages.square.edges import EdgedQuad
from slamcli.stages.square.search import Square, find_squares, refine_square

__all__ = ["EdgedQuad", "Square", "find_squares", "refine_square"]
