"""The methods of the literature, one file each: equations, networks, sizes, schedules."""

if __name__ != "dvae.models":
    raise ImportError(f"import this package as dvae.models, not as {__name__}: a second path loads a second copy")
