"""Comparisons of methods, scenes, settings and viewpoints; a folder or a file each."""
