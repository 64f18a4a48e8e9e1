"""File formats of Gaussians: PLY, SPZ, levels, increments, and SPZ's quantisation."""
