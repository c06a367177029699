"""Runs: directories that hold a fit and all it takes to go on with it, one run or many."""
