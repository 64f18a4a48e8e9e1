"""Reading and writing without losing anything: atomic files, locks, bounded archives, tables."""
