"""sagesplat: semantic-driven adaptive Gaussian splatting."""

__version__ = "0.1.0"
