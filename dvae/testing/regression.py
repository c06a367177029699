"""Regression tests of evidence bounds: detect a change of the code that makes a model worse, beyond Monte Carlo error.

The data are fixed, and the test compares the mean bound of these sequences before and after a change. The draws of the
guide are therefore the only source of error; the variation between sequences is not. The record keeps the mean over
sequences of each of its K draws, b_k. New draws b'_k use the same seeds, one for each k. The differences
d_k = b'_k - b_k are K independent numbers with mean

    E d_k = mean over sequences of (new bound - old bound).

If nothing has changed and d_k, a mean over sequences, is normal, then t = mean(d) sqrt(K) / sd(d) follows Student's t
with K - 1 degrees of freedom. The test fails if t is below the alpha quantile, hence with probability alpha. This holds
for any dependence of the new draw k on the old draw k. Equal seeds may couple them (an unchanged model gives d = 0),
decouple them (another network uses its random numbers in another order), or oppose them (a latent changed its sign).
Adding squared standard errors would be correct only in the second case. With a single stream of random numbers, one
additional number would couple draw k to draw k - 1, and the d_k to each other.

If the distribution of d is skewed upwards, K draws often contain no value of its upper tail. Then mean(d) and sd(d) are
too low, t is far below 0, and the test fails too often. This happens, for example, after a change from a sampled KL
term to an analytic one: old bounds have a long lower tail, new bounds do not, so d has a long upper tail. If the d_k
are skewed upwards, t is therefore also compared with the t of K log-normal draws. Their log-scale is the upper 95 %
confidence limit given the sample skewness of d, and at most 1.5. The test thus assumes that d is not more skewed than
these log-normal draws. The simulated rate of false alarms at alpha = .001 is at most .003 from 20 draws on; with
Student's t alone, it is .12.

A loss of delta nats is detected with probability 1 - beta if delta = (t_{1-alpha} + t_{1-beta}) sd(d) / sqrt(K). Four
times as many draws halve delta. With 20 draws the skewness of d is uncertain, and delta is twice as large.
"""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor, nn

from .. import files
from ..inference.bounds.elbo import SequenceELBO
from ..program.conditional import evaluating

Floats = NDArray[np.float64]

# Relative rounding error of a bound in float32, on another machine or with another order of summation.
ROUNDING = 1e-6
# Largest relative difference of equal data; data generated on another machine may differ in the last digits.
SAME_DATA = 1e-5


@dataclass(frozen=True)
class Record:
    """Stored bounds of B sequences from K draws, in nats.

    Args:
        bound: means over draws, (B,).
        error: Monte Carlo standard errors of `bound`, (B,).
        draws: means over sequences, (K,).
        data: dictionary from variable name to shape, root mean squares and checksums, as `checksums` returns it.
    """

    bound: Floats
    error: Floats
    draws: Floats
    data: dict[str, Any]

    @classmethod
    def of(cls, bounds: Floats, data: dict[str, Any]) -> Record:
        """Return the record of bounds (K, B)."""
        return cls(bounds.mean(0), bounds.std(0, ddof=1) / math.sqrt(len(bounds)), bounds.mean(1), data)

    @property
    def mean(self) -> float:
        """Mean bound."""
        return float(self.draws.mean())

    @property
    def mean_error(self) -> float:
        """Monte Carlo standard error of the mean bound."""
        return _standard_error(self.draws)

    def __str__(self) -> str:
        return f"{self.mean:.6g} ± {self.mean_error:.2g} nats a sequence"

    def dumps(self) -> str:
        """Return the record as JSON, with a line for each sequence."""
        rows = [[_round(b, 8), _round(e, 3)] for b, e in zip(self.bound, self.error, strict=True)]
        table = ",\n".join(f"    {json.dumps(row)}" for row in rows)
        head = {
            "particles": len(self.draws),
            "mean bound and its error": [_round(self.mean, 8), _round(self.mean_error, 3)],
            "data": self.data,
            "draws": [_round(b, 8) for b in self.draws],
        }
        lines = [f"  {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}," for key, value in head.items()]
        return "\n".join(["{", *lines, '  "sequences": [', table, "  ]", "}", ""])

    @classmethod
    def loads(cls, text: str) -> Record:
        """Return the record in a text written by `dumps`.

        Raises:
            ValueError: the text is not a record.
        """
        try:
            stored = json.loads(text)
            bound, error = np.array(stored["sequences"], dtype=float).reshape(-1, 2).T
            draws = np.array(stored["draws"], dtype=float)
            keys = ("shape", "rms", "checksums")
            data = {name: {key: entry[key] for key in keys} for name, entry in stored["data"].items()}
        except (KeyError, TypeError, AttributeError, ValueError) as problem:
            raise ValueError(f"not a record of bounds: {problem!r}") from problem
        if len(draws) != stored.get("particles") or len(draws) < 2:
            raise ValueError(
                f"not a record of bounds: it has {len(draws)} draws, but its 'particles' is {stored.get('particles')}"
            )
        return cls(bound, error, draws, data)


@dataclass(frozen=True)
class Change:
    """Comparison of new and old bounds of the same sequences, paired by draw.

    Args:
        old, new: records to compare.
        alpha: significance level, the probability that an unchanged model is reported as worse (or as better).
    """

    old: Record
    new: Record
    alpha: float

    @property
    def difference(self) -> float:
        """Difference of the mean bounds, new minus old."""
        return self.new.mean - self.old.mean

    @property
    def error(self) -> float:
        """Monte Carlo standard error of the difference."""
        return _standard_error(self.new.draws - self.old.draws)

    @property
    def p_worse(self) -> float:
        """p-value: probability of this difference or a lower one if the expected bound has not changed."""
        return self._p(1)

    @property
    def worse(self) -> bool:
        """Whether the bound fell significantly."""
        return self.p_worse < self.alpha

    @property
    def better(self) -> bool:
        """Whether the bound rose significantly."""
        return self._p(-1) < self.alpha

    def _p(self, sign: int) -> float:
        slack = ROUNDING * float(np.abs(self.old.bound).mean())
        t = (sign * self.difference + slack) / max(self.error, 1e-100)  # an exact bound has no error
        p = float(stats.t.cdf(t, len(self.new.draws) - 1))
        _, skewness = _t_and_skewness(sign * (self.new.draws - self.old.draws))
        if p >= self.alpha or skewness <= 0:
            return p
        least, reference = _log_normal_reference(len(self.new.draws))
        scale = min(int(np.searchsorted(least, skewness)), len(least) - 1)
        return max(p, float(np.searchsorted(reference[scale], t, side="right")) / reference.shape[1])

    def __str__(self) -> str:
        lines = [
            f"  old         {self.old}",
            f"  new         {self.new}",
            f"  difference  {self.difference:.4g}, standard error {self.error:.2g}, p = {self.p_worse:.1g} "
            f"(paired over {len(self.new.draws)} draws; alpha = {self.alpha:g})",
            f"  worst of {len(self.old.bound)} sequences:",
            f"  {'':>10}{'old':>14}{'new':>14}{'difference':>14}{'error':>10}",
        ]
        differences = self.new.bound - self.old.bound
        errors = np.hypot(self.new.error, self.old.error)
        for i in np.argsort(differences)[:5]:
            bounds = f"{self.old.bound[i]:14.6g}{self.new.bound[i]:14.6g}"
            lines.append(f"  {i:>10}{bounds}{differences[i]:14.4g}{errors[i]:10.2g}")
        return "\n".join(lines)


@dataclass
class ElboRegression:
    """Value of the pytest fixture `elbo_regression`; `check` compares the bound of a model with a record.

    Args:
        folder: folder of the test's records.
        test: name of the test, which is also the name of its record unless `check` gives another.
        update: whether to replace existing records by new ones.
        strict: whether the test fails if its record is missing.
        note: function that adds a line to the terminal summary.
        owners: dictionary from the file of each record read or written so far to the test that uses it.
    """

    folder: Path
    test: str
    update: bool
    strict: bool
    note: Callable[[str], None]
    owners: dict[Path, str]
    _claimed: set[Path] = field(default_factory=set, init=False)

    def check(
        self,
        model: Callable[..., Any],
        guide: Callable[..., Any],
        data: Any,
        *,
        name: str | None = None,
        particles: int = 100,
        alpha: float = 0.001,
        bound: Callable[[Any, int], Tensor] | None = None,
    ) -> None:
        """Check that the mean bound of the sequences is not significantly below the recorded one.

        The first use writes the record, which must be committed. A significantly better bound passes, and the terminal
        summary reports it. Draws use evaluation mode and seeds derived from the name of the record. torch's random
        state is restored.

        Args:
            model, guide: `DynamicalVAE.model` and `.guide`, or any pair of Pyro callables with sequences in their
                rightmost plate.
            data: argument of model and guide, such as x (B, T, D), a batch, or `Windows.all()`.
            name: name of the record; by default the name of the test.
            particles: number K of draws of every sequence. The error falls with its square root.
            alpha: probability of failing if the bound has not fallen.
            bound: function that replaces the evidence lower bound of model and guide. It takes the data and the seed of
                a draw and returns (B,), such as `lambda x, seed: dvae.annealed_bound(model, x, 10, seed=seed).bound`.

        Raises:
            AssertionError: the bound fell; old, new, difference, error and the worst sequences are printed.
            ValueError: the record is of other data or another number of particles, is damaged, or belongs to another
                test; bounds are not finite or not one for each sequence; `particles` is below 2; `alpha` is not between
                0 and 0.5.
        """
        __tracebackhide__ = True
        if particles < 2:
            raise ValueError(f"particles must be at least 2 to estimate the Monte Carlo error, got {particles}")
        if not 0 < alpha < 0.5:
            raise ValueError(f"alpha, the probability of false alarms, must be between 0 and 0.5, got {alpha}")
        stem = re.sub(r"[^\w.=-]+", "_", self.test if name is None else name).strip("_")
        path = self._claim(self.folder / f"{stem}.json")
        if self.strict and not self.update and not path.exists():
            raise AssertionError(f"record {_relative(path)} is missing; run without --elbo-strict, and commit it")
        bounds = measure(model, guide, data, particles, zlib.crc32(stem.encode()), bound)
        new = Record.of(bounds, checksums(data, bounds.shape[1]))
        if not path.exists():
            _write(path, new.dumps())
            quantiles = stats.t.ppf([1 - alpha, 0.9], particles - 1)
            loss = quantiles.sum() * math.sqrt(2) * new.mean_error
            power = f"a loss of {loss:.2g} would be detected with probability {'below ' * (particles < 100)}0.9"
            self.note(f"new, to be committed: {_relative(path)}: {new}; {power}")
        elif self.update:
            if new.dumps() != path.read_text(encoding="utf-8"):
                _write(path, new.dumps())
                self.note(f"renewed, to be committed: {_relative(path)}: {new}")
        else:
            self._compare(path, new, alpha)

    def _claim(self, path: Path) -> Path:
        if path in self._claimed or self.owners.setdefault(path, self.test) != self.test:
            raise ValueError(f"{_relative(path)} is already the record of {self.owners[path]}; pass another name=")
        self._claimed.add(path)
        return path

    def _compare(self, path: Path, new: Record, alpha: float) -> None:
        __tracebackhide__ = True
        try:
            old = Record.loads(path.read_text(encoding="utf-8"))
        except ValueError as problem:
            raise ValueError(
                f"{_relative(path)} is damaged ({problem}); restore it, or run with --update-elbo"
            ) from problem
        if len(old.draws) != len(new.draws):
            raise ValueError(
                f"{_relative(path)} has {len(old.draws)} particles, the test {len(new.draws)}: bounds cannot be "
                f"paired; pass particles={len(old.draws)}, or run with --update-elbo"
            )
        if other := _data_difference(old.data, new.data):
            raise ValueError(
                f"{_relative(path)} was made with other data: {other}; give the same, or run with --update-elbo"
            )
        change = Change(old, new, alpha)
        if change.worse:
            raise AssertionError(
                f"the evidence bound fell significantly\n{change}\n"
                f"if this is intended, run with --update-elbo and commit {_relative(path)}"
            )
        if change.better:
            rise = f"by {change.difference:.3g} ± {change.error:.2g} to {new}"
            self.note(f"better {rise}; run with --update-elbo to keep it: {_relative(path)}")


def measure(
    model: Callable[..., Any],
    guide: Callable[..., Any],
    data: Any,
    particles: int,
    seed: int,
    bound: Callable[[Any, int], Tensor] | None = None,
) -> Floats:
    """Return the bounds (K, B) of single draws, in evaluation mode; torch's random state is restored.

    Args:
        model, guide, data, bound: as in `ElboRegression.check`.
        particles: number K of draws.
        seed: seed of all draws; each draw has its own seed, derived from this one.

    Raises:
        ValueError: bounds are not finite, or not one for each sequence.
    """
    with torch.no_grad(), torch.random.fork_rng(range(torch.cuda.device_count())), ExitStack() as stack:
        for program in (model, guide):
            module = getattr(program, "__self__", program)
            if isinstance(module, nn.Module):
                stack.enter_context(evaluating(module))
        rows = []
        for draw_seed in np.random.SeedSequence(seed).generate_state(particles).tolist():
            torch.manual_seed(draw_seed)
            rows.append(_check_bound(bound(data, draw_seed) if bound else _bound(model, guide, data), data))
        bounds = np.stack(rows)
    if invalid := np.flatnonzero(~np.isfinite(bounds).all(0)).tolist():
        raise ValueError(f"the bound of sequence {_join_numbers(invalid)} is not finite")
    return bounds


def _bound(model: Callable[..., Any], guide: Callable[..., Any], data: Any) -> Any:
    terms = SequenceELBO().terms(model, data, guide)
    return sum(terms.log_likelihood.values()) - sum(terms.kl.values())


def _check_bound(bound: Any, data: Any) -> Floats:
    sizes = {len(value) for _, value in _leaves(data) if value.ndim}
    if not isinstance(bound, Tensor) or bound.dim() != 1 or len(bound) not in sizes:
        shape = tuple(bound.shape) if isinstance(bound, Tensor) else "no tensor, as no site is observed"
        raise ValueError(
            f"the bound is {shape}, expected one for each sequence; data have {sorted(sizes)} rows. Sequences belong "
            "in the rightmost plate: pyro.plate('sequences', B, dim=-1)"
        )
    return bound.double().cpu().numpy()


def checksums(data: Any, sequences: int) -> dict[str, Any]:
    """Return the shape, and the root mean square and checksum of every sequence, by variable.

    A checksum is a projection of the values onto fixed weights: unlike a hash, it can be compared with a tolerance.

    Raises:
        ValueError: data are not tensors, arrays or numbers, nor mappings or sequences of these.
    """

    def table(values: Floats) -> dict[str, Any]:
        finite = np.where(np.isfinite(values), values, 0)  # padding and missing entries may have any value
        rows = finite.reshape(sequences if values.shape[:1] == (sequences,) else 1, -1)
        sums = rows @ np.cos(np.arange(rows.shape[1])) / math.sqrt(rows.shape[1])
        rms = np.sqrt((rows**2).mean(1))
        numbers = {"rms": rms, "checksums": sums}
        rounded = {key: [_round(n, 6) for n in column] for key, column in numbers.items()}
        return {"shape": list(values.shape), **rounded}

    return {name: table(values) for name, values in _leaves(data)}


def _leaves(data: Any, prefix: str = "") -> Iterator[tuple[str, Floats]]:
    name = prefix or "data"
    if isinstance(data, Mapping | list | tuple):
        items = data.items() if isinstance(data, Mapping) else enumerate(data)
        for key, value in sorted(((str(key), value) for key, value in items), key=itemgetter(0)):
            yield from _leaves(value, f"{prefix}.{key}" if prefix else key)
    elif isinstance(data, Tensor):
        yield name, data.detach().double().cpu().numpy()
    elif isinstance(data, np.ndarray | float | int):
        yield name, np.asarray(data, dtype=float)
    elif data is not None:
        raise ValueError(
            f"{name} is {type(data).__name__}; expected tensors, arrays or numbers, or mappings or sequences of these"
        )


def _data_difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Return a description of the first difference of the data; "" if they are equal."""
    if old.keys() != new.keys():
        return f"it has {', '.join(old)}, the test has {', '.join(new)}"
    for name, now in new.items():
        if old[name]["shape"] != now["shape"]:
            return f"the shape of {name} was {tuple(old[name]['shape'])}, now {tuple(now['shape'])}"
        difference = np.array([np.subtract(now[key], old[name][key]) for key in ("rms", "checksums")])
        if differing := np.flatnonzero((np.abs(difference) > SAME_DATA * np.array(now["rms"])).any(0)).tolist():
            return f"{name} differs in sequence {_join_numbers(differing)}"
    return ""


def _t_and_skewness(draws: Floats) -> tuple[Floats, Floats]:
    """Return the t statistic and the skewness of draws (..., K)."""
    mean = draws.mean(-1, keepdims=True)
    variance = np.maximum(((draws - mean) ** 2).mean(-1), 1e-200)
    return mean[..., 0] * np.sqrt((draws.shape[-1] - 1) / variance), ((draws - mean) ** 3).mean(-1) / variance**1.5


@cache
def _log_normal_reference(count: int, sets: int = 10_000) -> tuple[Floats, Floats]:
    """Return the .05 quantile of skewness (S,) and sorted t statistics (S, sets) of log-normal draws at S scales."""
    noise = np.random.default_rng(0).normal(size=(sets, count))
    scales = np.linspace(0.1, 1.5, 8)
    t, skewness = zip(*(_t_and_skewness(np.exp(s * noise) - math.exp(s**2 / 2)) for s in scales), strict=True)
    return np.quantile(skewness, 0.05, axis=1), np.sort(t, axis=1)


def _standard_error(draws: Floats) -> float:
    return float(draws.std(ddof=1)) / math.sqrt(len(draws))


def _round(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def _join_numbers(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers[:8])) + (f" and {len(numbers) - 8} more" if len(numbers) > 8 else "")


def _relative(path: Path) -> Path:
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _write(path: Path, text: str) -> None:
    """Write a file atomically, because other processes may read and write it."""
    with files.atomic_write(path) as file:
        file.write(text.encode())
