"""Measurements: ``python -m physai.bench``."""
