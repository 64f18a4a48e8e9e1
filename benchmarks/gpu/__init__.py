"""`python -m benchmarks.gpu`: all that a machine with a GPU owes, unattended."""
