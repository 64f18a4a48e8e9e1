"""Files: atomic writes, locks, .npz archives with bounded memory, tables, PLY headers."""
