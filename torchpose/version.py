"""The version of the package: stands in results, caches and the wheel."""

__version__ = "0.1.0"
