"""Segments of motion as time-stamped frames on a body: cutting, completion, and uses of their latent space."""
