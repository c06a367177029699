"""Judges: models that are fitted to real motion, and say what they find of motion that a method makes."""
