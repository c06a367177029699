"""Migrations: configs of runs of earlier formats, as they would be written now.

Format 1 kept the protocol in place of a schema, so that the skeleton has to be looked up in the data; it knew motion
alone, and gave every method the options of those with a likelihood.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..inference.training.checkpoints import CheckpointError
from ..models.method import LatentMethod
from ..models.registry import judges, methods
from .kinds import DATA, opened

FORMAT = 2


def upgraded(config: Mapping[str, Any], run: Path, data: str | os.PathLike[str] | None = None) -> Mapping[str, Any]:
    """The config in the present format.

    Args:
        config: as it was written.
        run: its directory.
        data: where the data of the run lie now.

    Raises:
        CheckpointError: a format to come.
        KeyError: what every format has is missing.
    """
    version = config.get("format", 1)
    if version == FORMAT:
        return config
    if version != 1:
        raise CheckpointError(
            f"{run} is a run of format {version!r}, and this version of dvae reads formats up to {FORMAT}; install a "
            "newer one"
        )
    name = config["method"]["method"]
    kind = judges()[name] if name in judges() else methods()[name]
    aside = {option.name for option in fields(LatentMethod)} - {option.name for option in fields(kind)}
    method = {option: value for option, value in config["method"].items() if option not in aside}
    source = DATA["motion"].source(**config["data"])
    try:
        schema = opened(run, "motion", source, config["protocol"], data).schema
    except CheckpointError:
        if data is None:
            raise
        schema = opened(run, "motion", source, config["protocol"]).schema  # the run is to be used on other data
    described = {"kind": schema.kind, **schema.config()}
    now = {"method": method, "schema": described, "data": {"kind": "motion", **config["data"]}}
    return {**config, **now, "format": FORMAT}
