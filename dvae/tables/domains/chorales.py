"""Chorales: settings in four parts by J. S. Bach as rolls of 88 keys, a step a quarter note, from music21's corpus.

The benchmark of Boulanger-Lewandowski, Bengio and Vincent (2012, arXiv 1206.6392), "JSB chorales", has 382 settings,
brought to C major or C minor, with the keys that are down at every quarter note: 229 for training, 76 for validation
and 77 for test, of those by Allan and Williams (2005). Its files do not say which setting is which, so that its split
cannot be made. This one has the same sizes; which settings are in it, and where, is by the SHA-256 of their names in
music21. Figures on the two are alike, and do not compare to a tenth of a nat.

Of the settings that music21 has by Bach, left out are those that

* have other voices than one soprano, alto, tenor and bass (instruments beside these are not read), or a beat that is no
  quarter or half note;
* share two thirds of their chord changes with one that is kept, in whatever key: Bach used some twice, and music21 has
  some in two editions. The benchmark may have such pairs on both sides of its split;
* have the largest SHA-256, beyond 382.

Steps without any voice are left out too, which are interludes of instruments and rests at the end.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ... import files
from ...lazy import optional
from ..columns import Column, Columns
from ..panel import Panel, Series
from .published import folder, lot

VOICES = ("Soprano", "Alto", "Tenor", "Bass")
KEYS = range(21, 109)
"""MIDI numbers of a piano's keys, A0 to C8."""
CLASSES = ("C", "C#", "D", "D#", "E", "F", "F#", "G", "G#", "A", "A#", "B")
NAMES = tuple(f"{CLASSES[key % 12]}{key // 12 - 1}" for key in KEYS)
SIZES = {"train": 229, "validation": 76, "test": 77}
SHARED = 2 / 3
"""Of its chord changes, from which on a setting is one that is there already."""
MOST = 2**23
"""Bytes that the cache can rightly have; it has a twentieth."""
PROFILES = (
    (17.7661, 0.145624, 14.9265, 0.160186, 19.8049, 11.3587, 0.291248, 22.062, 0.145624, 8.15494, 0.232998, 4.95122),
    (18.2648, 0.737619, 14.0499, 16.8599, 0.702494, 14.4362, 0.702494, 18.6161, 4.56621, 1.93186, 7.37619, 1.75623),
)
"""How often a major and a minor key have each degree, in hundredths (Aarden 2003; Essen folksongs)."""


def chorales(transposed: bool = True, cache: Path | None = None) -> Panel:
    """Bach's chorales.

    Reading all settings takes music21 half a minute, once: pitches are kept in the user's cache.

    Args:
        transposed: bring all to C major or C minor, as in the benchmark; by at most six semitones.
        cache: folder for the pitches; that of the user for this library, if not given.

    Raises:
        ImportError: music21 is not installed.
        ValueError: the cache holds something else, or music21's corpus fewer settings.
    """
    folder("music21", "chorales")
    pooch = optional("pooch", "chorales")
    path = Path(cache or pooch.os_cache("dvae")) / f"chorales-{version('music21')}.json"
    if not path.exists():
        content = json.dumps({name: found.tolist() for name, found in _settings().items()})
        with files.written(path) as file:
            files.put(file, content.encode())
    return _panel(_read(path), transposed)


def _panel(settings: Mapping[str, np.ndarray], transposed: bool) -> Panel:
    chosen = sorted(different(settings), key=lot)[: sum(SIZES.values())]
    if len(chosen) < sum(SIZES.values()):
        raise ValueError(f"music21 has {len(chosen)} different settings, of {sum(SIZES.values())}; install a newer one")
    splits = [split for split, size in SIZES.items() for _ in range(size)]
    series = []
    for name, split in sorted(zip(chosen, splits, strict=True)):
        voices = settings[name][(settings[name] > 0).any(1)]
        series.append(Series(name, roll(to_c(voices) if transposed else voices), split=split))
    return Panel(series, Columns(tuple(Column(name, family="binary") for name in NAMES)), "chorales")


def roll(voices: np.ndarray) -> np.ndarray:
    """The keys that are down: (T, 88) of 0 and 1, from MIDI numbers (T, 4), 0 where a voice rests."""
    found: np.ndarray = (voices[:, :, None] == np.array(KEYS)).any(1).astype(float)
    return found


def to_c(voices: np.ndarray) -> np.ndarray:
    """The voices (T, 4) brought to C major or C minor, at most six semitones away."""
    up = -tonic(voices) % 12
    return np.where(voices > 0, voices + (up if up < 6 else up - 12), 0)


def tonic(voices: np.ndarray) -> int:
    """The pitch class, from C, of the key whose profile has the highest correlation with how often pitches sound.

    Krumhansl and Schmuckler's rule (Krumhansl 1990), with the profiles of Aarden (2003).

    Args:
        voices: MIDI numbers (T, 4), 0 where a voice rests.
    """
    sounding = np.bincount(voices[voices > 0] % 12, minlength=12)
    fits = [[np.corrcoef(np.roll(profile, key), sounding)[0, 1] for key in range(12)] for profile in PROFILES]
    return int(np.argmax(np.max(fits, 0)))


def different(settings: Mapping[str, np.ndarray]) -> list[str]:
    """Names of the settings that no earlier one in the order of names repeats."""
    kept: dict[str, set[Any]] = {}
    for name in sorted(settings):
        own = changes(settings[name])
        if all(len(own & other) < SHARED * min(len(own), len(other)) for other in kept.values()):
            kept[name] = own
    return list(kept)


def changes(voices: np.ndarray) -> set[tuple[int, ...]]:
    """The steps of the bass with the chords above it before and behind, the same in all keys."""
    full = voices[(voices > 0).all(1)]
    bass, above = full[:, 3:], full[:, :3] - full[:, 3:]
    return set(map(tuple, np.hstack([np.diff(bass, axis=0), above[:-1], above[1:]]).tolist()))


def _read(path: Path) -> dict[str, np.ndarray]:
    """What the cache holds."""
    try:
        found = {name: np.asarray(voices, np.int64) for name, voices in json.loads(files.read(path, MOST)).items()}
        if all(v.ndim == 2 and v.shape[1] == 4 and np.isin(v, (0, *KEYS)).all() for v in found.values()):
            return found
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        pass
    raise ValueError(f"{path} does not hold the pitches of chorales; delete it, and it is made anew")


def _settings() -> dict[str, np.ndarray]:
    """MIDI numbers (T, 4) at every quarter note of all settings with four voices in music21's corpus, by name."""
    from music21 import converter, corpus

    found = {}
    for path in map(Path, corpus.getComposer("bach")):
        if path.suffix not in (".mxl", ".xml"):
            continue
        score = converter.parse(path, forceSource=True, storePickle=False)
        beats = {signature.denominator for signature in score.recurse().getElementsByClass("TimeSignature")}
        parts = [[part for part in score.parts if (part.partName or "").startswith(voice)] for voice in VOICES]
        if all(len(own) == 1 for own in parts) and beats <= {2, 4}:
            found[path.stem] = quarters([_notes(own[0]) for own in parts])
    return found


def _notes(part: Any) -> list[tuple[float, float, int]]:
    """Beginning and length of each note of a part, in quarter notes, and its MIDI number."""
    return [(float(note.offset), float(note.quarterLength), note.pitches[-1].midi) for note in part.flatten().notes]


def quarters(voices: Sequence[Sequence[tuple[float, float, int]]]) -> np.ndarray:
    """What sounds at every quarter note: (T, V) MIDI numbers, 0 where a voice rests.

    Args:
        voices: of each its notes, as beginning, length and MIDI number.
    """
    ends = [start + length for notes in voices for start, length, _ in notes]
    found = np.zeros((int(np.ceil(max(ends, default=0))), len(voices)), np.int64)
    for voice, notes in enumerate(voices):
        for start, length, pitch in notes:
            found[int(np.ceil(start)) : int(np.ceil(start + length)), voice] = pitch
    return found
