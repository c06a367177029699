"""Hostile and random examples, for as long as one likes."""
