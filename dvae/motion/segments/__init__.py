"""Segments of motion as time-stamped frames on a body: cut from motion, seen whole, and what is done with a latent
space of them."""
