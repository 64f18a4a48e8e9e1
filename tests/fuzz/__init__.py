"""Damages files for every reader of the package: `python -m tests.fuzz` (docs/development.md)."""
