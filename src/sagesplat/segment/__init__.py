"""Semantics: label images of the views, and the labels of points that follow from them."""
