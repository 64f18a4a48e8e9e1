"""What every room uses: Gaussians, harmonics, geometry, settings, events, errors."""
