"""The built web viewer, in `static/`: made from web/ by `npm run build`, copied into every bundle."""
