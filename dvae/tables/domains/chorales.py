"""Chorales: settings in four parts by J. S. Bach as rolls of 88 keys, one step per quarter note, from music21's corpus.

The benchmark "JSB chorales" of Boulanger-Lewandowski, Bengio and Vincent (2012, arXiv 1206.6392) has 382 settings,
transposed to C major or C minor. It stores the keys that are down at every quarter note. Its split has 229 settings for
training, 76 for validation and 77 for test, and follows Allan and Williams (2005). Its files do not identify the
settings, and the split cannot be reproduced. This data set has the same sizes; the SHA-256 of the names in music21
selects the settings and their split. Scores on the two are similar, but not comparable to a tenth of a nat.

The following of Bach's settings in music21 are omitted:

* settings with other voices than one soprano, alto, tenor and bass (instruments in addition to these are ignored), or
  with a beat other than a quarter or half note;
* settings that share two thirds of their chord changes with one that is kept, in any key: Bach used some twice, and
  music21 has some in two editions. The benchmark may have such pairs on both sides of its split;
* the settings with the largest SHA-256, beyond 382.

Steps without any voice are omitted too: interludes of instruments and rests at the end.
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
from .published import name_hash, package_folder

VOICES = ("Soprano", "Alto", "Tenor", "Bass")
KEYS = range(21, 109)
"""MIDI numbers of a piano's keys, A0 to C8."""
CLASSES = ("C", "C#", "D", "D#", "E", "F", "F#", "G", "G#", "A", "A#", "B")
NAMES = tuple(f"{CLASSES[key % 12]}{key // 12 - 1}" for key in KEYS)
SIZES = {"train": 229, "validation": 76, "test": 77}
SHARED = 2 / 3
"""Share of chord changes from which on a setting counts as a duplicate."""
MOST = 2**23
"""Maximum bytes of the cache; its actual size is a twentieth."""
PROFILES = (
    (17.7661, 0.145624, 14.9265, 0.160186, 19.8049, 11.3587, 0.291248, 22.062, 0.145624, 8.15494, 0.232998, 4.95122),
    (18.2648, 0.737619, 14.0499, 16.8599, 0.702494, 14.4362, 0.702494, 18.6161, 4.56621, 1.93186, 7.37619, 1.75623),
)
"""Frequencies of the degrees in a major and a minor key, in hundredths (Aarden 2003; Essen folksongs)."""


def chorales(transposed: bool = True, cache: Path | None = None) -> Panel:
    """Load Bach's chorales.

    The first call parses all settings with music21, which takes half a minute. Pitches are then cached.

    Args:
        transposed: transpose all settings to C major or C minor by at most six semitones, as in the benchmark.
        cache: folder for the pitches; by default the user's cache of this library.

    Raises:
        ImportError: if music21 is not installed.
        ValueError: if the cache has other content, or music21's corpus has too few settings.
    """
    package_folder("music21", "chorales")
    pooch = optional("pooch", "chorales")
    path = Path(cache or pooch.os_cache("dvae")) / f"chorales-{version('music21')}.json"
    if not path.exists():
        content = json.dumps({name: voices.tolist() for name, voices in _settings().items()})
        with files.atomic_write(path) as file:
            files.write_all(file, content.encode())
    return _panel(_read(path), transposed)


def _panel(settings: Mapping[str, np.ndarray], transposed: bool) -> Panel:
    selected = sorted(different(settings), key=name_hash)[: sum(SIZES.values())]
    if len(selected) < sum(SIZES.values()):
        raise ValueError(
            f"music21 has {len(selected)} different settings; expected {sum(SIZES.values())}, install a newer music21"
        )
    splits = [split for split, size in SIZES.items() for _ in range(size)]
    series = []
    for name, split in sorted(zip(selected, splits, strict=True)):
        voices = settings[name][(settings[name] > 0).any(1)]
        series.append(Series(name, roll(to_c(voices) if transposed else voices), split=split))
    return Panel(series, Columns(tuple(Column(name, family="binary") for name in NAMES)), "chorales")


def roll(voices: np.ndarray) -> np.ndarray:
    """Return the keys that are down, (T, 88) of 0 and 1, from MIDI numbers (T, 4), 0 where a voice rests."""
    keys_down: np.ndarray = (voices[:, :, None] == np.array(KEYS)).any(1).astype(float)
    return keys_down


def to_c(voices: np.ndarray) -> np.ndarray:
    """Return the voices (T, 4) transposed to C major or C minor, by at most six semitones."""
    up = -tonic(voices) % 12
    return np.where(voices > 0, voices + (up if up < 6 else up - 12), 0)


def tonic(voices: np.ndarray) -> int:
    """Return the tonic's pitch class, from C: the key whose profile has the highest correlation with the pitch counts.

    This is the rule of Krumhansl and Schmuckler (Krumhansl 1990), with the profiles of Aarden (2003).

    Args:
        voices: MIDI numbers (T, 4), 0 where a voice rests.
    """
    sounding = np.bincount(voices[voices > 0] % 12, minlength=12)
    fits = [[np.corrcoef(np.roll(profile, key), sounding)[0, 1] for key in range(12)] for profile in PROFILES]
    return int(np.argmax(np.max(fits, 0)))


def different(settings: Mapping[str, np.ndarray]) -> list[str]:
    """Return the names of the settings that do not repeat an earlier one, in the order of names."""
    unique: dict[str, set[Any]] = {}
    for name in sorted(settings):
        steps = changes(settings[name])
        if all(len(steps & other) < SHARED * min(len(steps), len(other)) for other in unique.values()):
            unique[name] = steps
    return list(unique)


def changes(voices: np.ndarray) -> set[tuple[int, ...]]:
    """Return the steps of the bass, each with the chords above it before and after; independent of the key."""
    full = voices[(voices > 0).all(1)]
    bass, above = full[:, 3:], full[:, :3] - full[:, 3:]
    return set(map(tuple, np.hstack([np.diff(bass, axis=0), above[:-1], above[1:]]).tolist()))


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return the validated content of the cache."""
    try:
        settings = {name: np.asarray(voices, np.int64) for name, voices in json.loads(files.read(path, MOST)).items()}
        if all(v.ndim == 2 and v.shape[1] == 4 and np.isin(v, (0, *KEYS)).all() for v in settings.values()):
            return settings
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        pass
    raise ValueError(f"{path} does not contain the pitches of chorales; delete it to build it again")


def _settings() -> dict[str, np.ndarray]:
    """Return MIDI numbers (T, 4) per quarter note of all settings with four voices in music21's corpus, by name."""
    from music21 import converter, corpus

    settings = {}
    for path in map(Path, corpus.getComposer("bach")):
        if path.suffix not in (".mxl", ".xml"):
            continue
        score = converter.parse(path, forceSource=True, storePickle=False)
        beats = {signature.denominator for signature in score.recurse().getElementsByClass("TimeSignature")}
        parts = [[part for part in score.parts if (part.partName or "").startswith(voice)] for voice in VOICES]
        if all(len(matching) == 1 for matching in parts) and beats <= {2, 4}:
            settings[path.stem] = quarters([_notes(matching[0]) for matching in parts])
    return settings


def _notes(part: Any) -> list[tuple[float, float, int]]:
    """Return start and length of each note of a part, in quarter notes, and its MIDI number."""
    return [(float(note.offset), float(note.quarterLength), note.pitches[-1].midi) for note in part.flatten().notes]


def quarters(voices: Sequence[Sequence[tuple[float, float, int]]]) -> np.ndarray:
    """Return the pitches at every quarter note, (T, V) MIDI numbers, 0 where a voice rests.

    Args:
        voices: notes of each voice, as start, length and MIDI number.
    """
    ends = [start + length for notes in voices for start, length, _ in notes]
    pitches = np.zeros((int(np.ceil(max(ends, default=0))), len(voices)), np.int64)
    for voice, notes in enumerate(voices):
        for start, length, pitch in notes:
            pitches[int(np.ceil(start)) : int(np.ceil(start + length)), voice] = pitch
    return pitches
