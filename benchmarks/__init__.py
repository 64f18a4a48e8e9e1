"""Figures that are measured, not tested: `python -m benchmarks.NAME`."""
