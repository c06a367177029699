"""Download freely available recordings, verified by their SHA-256.

CMU Graphics Lab Motion Capture Database, mocap.cs.cmu.edu: free for all uses; the data may not be resold. "The data
used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217."
"""

from __future__ import annotations

from pathlib import Path

from ...lazy import optional

COLLECTIONS: dict[str, tuple[str, dict[str, str]]] = {
    "cmu": (
        "http://mocap.cs.cmu.edu/subjects/",
        {
            "02/02.asf": "c9f5ff45b4437b279f58b95dacf017afd3135373096274df69436a9354d796cf",
            "02/02_01.amc": "1503c481f4726e640c77888f0c841dd3be0694684bcd32296cf53685c6fc1492",
            "02/02_03.amc": "07df256876f0941ea464083162503790a05ffa021fd6d6d5b2c22ac98127762a",
            "02/02_04.amc": "77a6885616eb91a76304149a42575cb8479ef9dd118b329e4d1de6046766491f",
        },
    ),
}
"""Name -> URL of the folder, and its files with their SHA-256."""


def get(name: str, out: str | Path, url: str | None = None) -> list[Path]:
    """Download the missing files of a collection; files with a wrong checksum are not kept.

    Args:
        name: name of the collection, one of `COLLECTIONS`.
        out: output folder; subfolders are the same as at the URL.
        url: URL of a mirror.

    Returns:
        Paths of all files of the collection.

    Raises:
        ValueError: the name is unknown, or the checksum of a file is wrong.
        OSError: a file cannot be downloaded or written.
    """
    if name not in COLLECTIONS:
        raise ValueError(f"no collection {name!r}; known: {', '.join(COLLECTIONS)}")
    pooch = optional("pooch", "motion")

    address, files = COLLECTIONS[name]
    address = (url or address).rstrip("/") + "/"
    fetcher = pooch.create(path=out, base_url=address, registry={f: f"sha256:{digest}" for f, digest in files.items()})
    pooch.get_logger().setLevel("WARNING")
    paths = []
    for file in files:
        try:
            paths.append(Path(fetcher.fetch(file)))
        except ValueError as error:
            raise ValueError(f"{address}{file}: the downloaded file differs from the expected one ({error})") from None
        except OSError as error:
            raise OSError(f"{address}{file} cannot be downloaded: {error}") from None
    return paths
