"""Reports: what is known of fitted runs, on one page that needs nothing else.

`sections` are of any sequences; an application adds its own, as `dvae report` does with moving skeletons.
"""

from .page import Section, document, lacking

__all__ = ["Section", "document", "lacking"]
