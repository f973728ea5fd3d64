"""Synthesis: drawn people, how they move, and stereo recordings of them with exact truth."""
