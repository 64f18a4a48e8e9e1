"""The paper's evaluation of a run: its tables and figures."""
