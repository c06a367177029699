"""Bounds, the shared loop, forecasting, evaluation and comparison."""

if __name__ != "dvae.inference":
    raise ImportError(f"import this package as dvae.inference, not as {__name__}: a second path loads a second copy")
