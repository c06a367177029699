"""Metric models: models fitted to real motion that score the motion of other models."""
