"""Reports: all results of fitted runs on one self-contained page.

`sections` contains the sections for any sequences. An application adds its own, as `dvae report` does with moving
skeletons.
"""

from .page import Section, document, missing_part

__all__ = ["Section", "document", "missing_part"]
