"""Bundles for the web viewer, and the server that shows them.

`static/` is the built viewer: made from web/ by `npm run build`, and copied into every bundle.
"""
