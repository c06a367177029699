"""Tables: sequences of numbers, counts and classes with covariates, from common data structures, as data for models.

>>> import pandas as pd
>>> frame = pd.DataFrame({"day": range(6), "riders": [3, 5, 2, 4, 6, 1], "open": [1, 1, 0, 1, 1, 0]})
>>> table = dvae.tables.Panel.of(frame)
>>> {column.name: column.family for column in table.columns.targets}
{'riders': 'count', 'open': 'binary'}
"""

from .column_inference import ColumnHints, infer_columns
from .columns import Column, Columns
from .dataset import PanelData
from .forecasts import PanelForecasts, PanelImputed, panel_scores
from .panel import Panel, Series
from .protocol import Cut
from .windows import PanelWindows

__all__ = [
    "Column",
    "ColumnHints",
    "Columns",
    "Cut",
    "Panel",
    "PanelData",
    "PanelForecasts",
    "PanelImputed",
    "PanelWindows",
    "Series",
    "infer_columns",
    "panel_scores",
]
