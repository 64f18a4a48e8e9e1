"""Training 3D Gaussians from photos, level by level."""
