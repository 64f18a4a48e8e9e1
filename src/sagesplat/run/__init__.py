"""A run folder being worked on: its names and provenance, stages done once, work done elsewhere."""
