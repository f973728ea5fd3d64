"""Accuracy beside time on public data: `python -m benchmarks.NAME` prints a table, `--json FILE` keeps it."""
