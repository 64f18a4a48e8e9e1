"""The nested levels beside their baselines."""
