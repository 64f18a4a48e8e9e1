"""Internet scale by simulation: recorded visits, a content delivery network, costs (docs/scaling.md)."""
