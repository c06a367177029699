"""Speech: power spectra of recorded prompts, from Debian's package asterisk-core-sounds-en-wav (CC BY-SA 3.0).

The data are 568 files at 8 kHz, spoken by Allison Smith. Spectra follow the benchmark of Bie, Girin, Leglaive, Hueber
and Alameda-Pineda (2021, arXiv 2106.06500) for the speech models of the review (Girin et al. 2021, arXiv 2008.12595). A
signal is divided by its largest absolute value. Windows are half a sine, 32 ms long and 16 ms apart. Frames more than
30 dB below the loudest one are cut from beginning and end. At 8 kHz the spectra have 129 bands; the benchmark, at 16
kHz, has 257. The power of rounding to 16 bits is added to each power, since spectra contain no information below it.

`resynthesised` turns an estimate of the power into sound, with the phase of the observed signal. `si_sdr` evaluates it
by the scale-invariant signal-to-distortion ratio (Le Roux, Wisdom, Erdogan and Hershey 2019, arXiv 1811.02508).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import signal
from scipy.io import wavfile

from ..columns import Column, Columns
from ..panel import Panel, Series
from .published import name_hash

PLACE = Path("/usr/share/asterisk/sounds/en_US_f_Allison")
RATE, WINDOW, HOP = 8000, 256, 128
"""Samples per second, per window, and from one window to the next."""
FLOOR = WINDOW / 2 * 2.0**-30 / 12
"""Power of rounding to 16 bits in every band, for signals up to 1."""
QUIET = 30.0
"""Decibels below the loudest frame at which the beginning and the end count as silence."""
SILENT = 0.01
"""Largest absolute value of recordings of silence, which are omitted; speech reaches values up to 1."""
TENTHS = {0: "validation", 1: "test"}
"""Split of the recordings whose `name_hash` ends in this digit; all others are for training."""


def speech(folder: str | Path = PLACE) -> Panel:
    """Return power spectra (T, 129) of recordings, one frame every 16 ms.

    Args:
        folder: folder of the wav files, searched recursively.

    Raises:
        FileNotFoundError: if the folder has no wav files.
        ValueError: if a file is not mono with 16 bits and 8 kHz.
    """
    series = [
        Series(name, power(samples), split=TENTHS.get(name_hash(name) % 10, "train"))
        for name, samples in recordings(folder).items()
    ]
    hertz = np.arange(WINDOW // 2 + 1) * RATE / WINDOW
    columns = tuple(Column(f"{band:g} Hz", family="power") for band in hertz)
    return Panel(series, Columns(columns), "speech")


def recordings(folder: str | Path = PLACE) -> dict[str, np.ndarray]:
    """Return signals (samples,) by name, between -1 and 1, without the silence around them, as in `speech`."""
    paths = sorted(Path(folder).rglob("*.wav"))
    if not paths:
        raise FileNotFoundError(
            f"no wav files in {folder}; on Debian: apt install asterisk-core-sounds-en-wav, or give their folder"
        )
    signals = {}
    for path in paths:
        rate, samples = wavfile.read(path)
        if rate != RATE or samples.ndim != 1 or samples.dtype != np.int16:
            raise ValueError(
                f"{path} has {rate} Hz, {samples.dtype}, shape {samples.shape}; expected mono, 16 bits, 8 kHz"
            )
        values = samples / 2.0**15
        if len(values) >= WINDOW and np.abs(values).max() > SILENT:
            signals[path.relative_to(folder).with_suffix("").as_posix()] = voiced(values / np.abs(values).max())
    return signals


def voiced(samples: np.ndarray) -> np.ndarray:
    """Return a signal without the quiet frames at its beginning and end."""
    loud = 10 * np.log10(power(samples).sum(1))
    first, last = np.flatnonzero(loud > loud.max() - QUIET)[[0, -1]]
    return samples[max(first - 1, 0) * HOP : (last + 1) * HOP]


def _transform() -> signal.ShortTimeFFT:
    return signal.ShortTimeFFT(signal.windows.cosine(WINDOW), HOP, RATE)


def spectrum(samples: np.ndarray) -> np.ndarray:
    """Return the complex spectrum (T, 129) of a signal (samples,), at least as long as a window."""
    coefficients: np.ndarray = _transform().stft(samples).T
    return coefficients


def power(samples: np.ndarray) -> np.ndarray:
    """Return squared magnitudes (T, 129) of the spectrum of a signal, plus `FLOOR`."""
    powers: np.ndarray = np.abs(spectrum(samples)) ** 2 + FLOOR
    return powers


def sound(spectrum: np.ndarray, samples: int) -> np.ndarray:
    """Return the signal (samples,) of a complex spectrum (T, 129)."""
    waveform: np.ndarray = _transform().istft(np.asarray(spectrum).T, k1=samples)
    return waveform


def resynthesised(estimate: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the signal (samples,) of a power (T, 129) with the phase of an observed signal.

    Raises:
        ValueError: if the shapes of the power and of the signal's spectrum differ.
    """
    observed = spectrum(samples)
    if estimate.shape != observed.shape:
        raise ValueError(f"the power has shape {estimate.shape}, but the spectrum of the signal {observed.shape}")
    return sound(np.sqrt(estimate) * np.exp(1j * np.angle(observed)), len(samples))


def si_sdr(reference: np.ndarray, estimate: np.ndarray) -> float:
    """Return the scale-invariant signal-to-distortion ratio of an estimate (samples,), in decibels.

        10 log10 ‖a s‖² / ‖a s - ŝ‖²,    a = <ŝ, s> / ‖s‖²

    This is equation 3 of Le Roux et al. 2019; it is infinite if the estimate is a multiple of the signal.

    Raises:
        ValueError: if lengths differ, or the signal is all zeros.
    """
    if reference.shape != estimate.shape or not reference.any():
        raise ValueError(f"expected two signals of one length, not silent; got {reference.shape} and {estimate.shape}")
    target = estimate @ reference / (reference @ reference) * reference
    with np.errstate(divide="ignore"):
        return float(10 * np.log10(target @ target / ((target - estimate) @ (target - estimate))))
