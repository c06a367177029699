"""Speech: power spectra of recorded prompts, from Debian's package asterisk-core-sounds-en-wav (CC BY-SA 3.0).

568 files of 8 kHz, spoken by Allison Smith. Spectra are made as in the benchmark of Bie, Girin, Leglaive, Hueber and
Alameda-Pineda (2021, arXiv 2106.06500), of the review's speech models (Girin et al. 2021, arXiv 2008.12595): a signal
is divided by its largest absolute value, windows are halves of a sine, 32 ms long and 16 ms apart, and what is more
than 30 dB below the loudest frame is cut from beginning and end. At 8 kHz these are 129 bands, where theirs, at 16 kHz,
are 257. To each power that of rounding to 16 bits is added, below which spectra tell nothing.

An estimate of the power becomes sound again with the phase that was observed (`resynthesised`), and is judged by the
scale-invariant signal-to-distortion ratio (`si_sdr`; Le Roux, Wisdom, Erdogan and Hershey 2019, arXiv 1811.02508).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import signal
from scipy.io import wavfile

from ..columns import Column, Columns
from ..panel import Panel, Series
from .published import lot

PLACE = Path("/usr/share/asterisk/sounds/en_US_f_Allison")
RATE, WINDOW, HOP = 8000, 256, 128
"""Samples: in a second, in a window, from one window to the next."""
FLOOR = WINDOW / 2 * 2.0**-30 / 12
"""Power of rounding to 16 bits in every band, of signals up to 1."""
QUIET = 30.0
"""Decibels below the loudest frame, from which on beginning and end are silence."""
SILENT = 0.01
"""Largest absolute value of recordings of silence, which are left out; that of speech is up to 1."""
TENTHS = {0: "validation", 1: "test"}
"""Part of the recordings whose lot ends in this digit; all others are for training."""


def speech(folder: str | Path = PLACE) -> Panel:
    """Power spectra (T, 129) of recordings, a frame every 16 ms.

    Args:
        folder: of the wav files, searched with all below it.

    Raises:
        FileNotFoundError: there are none.
        ValueError: a file of another kind than mono, 16 bits, 8 kHz.
    """
    series = [
        Series(name, power(samples), split=TENTHS.get(lot(name) % 10, "train"))
        for name, samples in recordings(folder).items()
    ]
    hertz = np.arange(WINDOW // 2 + 1) * RATE / WINDOW
    columns = tuple(Column(f"{band:g} Hz", family="power") for band in hertz)
    return Panel(series, Columns(columns), "speech")


def recordings(folder: str | Path = PLACE) -> dict[str, np.ndarray]:
    """Signals (samples,) by name, between -1 and 1, without the silence around them; see `speech`."""
    paths = sorted(Path(folder).rglob("*.wav"))
    if not paths:
        raise FileNotFoundError(
            f"no wav files in {folder}; on Debian: apt install asterisk-core-sounds-en-wav, or give their folder"
        )
    found = {}
    for path in paths:
        rate, samples = wavfile.read(path)
        if rate != RATE or samples.ndim != 1 or samples.dtype != np.int16:
            raise ValueError(
                f"{path} has {rate} Hz, {samples.dtype}, shape {samples.shape}; expected mono, 16 bits, 8 kHz"
            )
        values = samples / 2.0**15
        if len(values) >= WINDOW and np.abs(values).max() > SILENT:
            found[path.relative_to(folder).with_suffix("").as_posix()] = voiced(values / np.abs(values).max())
    return found


def voiced(samples: np.ndarray) -> np.ndarray:
    """A signal without the frames before the first and behind the last that is not quiet."""
    loud = 10 * np.log10(power(samples).sum(1))
    first, last = np.flatnonzero(loud > loud.max() - QUIET)[[0, -1]]
    return samples[max(first - 1, 0) * HOP : (last + 1) * HOP]


def _transform() -> signal.ShortTimeFFT:
    return signal.ShortTimeFFT(signal.windows.cosine(WINDOW), HOP, RATE)


def spectrum(samples: np.ndarray) -> np.ndarray:
    """The complex spectrum (T, 129) of a signal (samples,) of a window's length at least."""
    found: np.ndarray = _transform().stft(samples).T
    return found


def power(samples: np.ndarray) -> np.ndarray:
    """Squared magnitudes (T, 129) of the spectrum of a signal, above `FLOOR`."""
    found: np.ndarray = np.abs(spectrum(samples)) ** 2 + FLOOR
    return found


def sound(spectrum: np.ndarray, samples: int) -> np.ndarray:
    """The signal (samples,) of a complex spectrum (T, 129)."""
    found: np.ndarray = _transform().istft(np.asarray(spectrum).T, k1=samples)
    return found


def resynthesised(estimate: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """The signal (samples,) of a power (T, 129) with the phase of an observed signal.

    Raises:
        ValueError: a power of another shape than that of the signal's spectrum.
    """
    observed = spectrum(samples)
    if estimate.shape != observed.shape:
        raise ValueError(f"the power has shape {estimate.shape}, and the spectrum of the signal {observed.shape}")
    return sound(np.sqrt(estimate) * np.exp(1j * np.angle(observed)), len(samples))


def si_sdr(reference: np.ndarray, estimate: np.ndarray) -> float:
    """Scale-invariant signal-to-distortion ratio in decibels, of an estimate (samples,) of a signal (samples,).

        10 log10 ‖a s‖² / ‖a s - ŝ‖²,    a = <ŝ, s> / ‖s‖²

    Le Roux et al. 2019, equation 3; infinite where the estimate is a multiple of the signal.

    Raises:
        ValueError: different lengths, or a signal of zeros.
    """
    if reference.shape != estimate.shape or not reference.any():
        raise ValueError(f"expected two signals of one length, not silent; got {reference.shape} and {estimate.shape}")
    target = estimate @ reference / (reference @ reference) * reference
    with np.errstate(divide="ignore"):
        return float(10 * np.log10(target @ target / ((target - estimate) @ (target - estimate))))
