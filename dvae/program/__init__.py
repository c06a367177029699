"""What runs: a batch read and checked, the factors of two equations, and the Pyro programs made of them."""
