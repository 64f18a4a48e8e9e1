"""Fidelity on a walk at equal splats and equal bytes: ours beside what people would pick instead."""
