"""File formats of splats: PLY, SPZ, levels, increments, and the rounding that they do."""
