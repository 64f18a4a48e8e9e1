"""Semantics: label images of the views, and 2D-to-3D label transfer to the points."""
