"""Models of one run used on another."""
