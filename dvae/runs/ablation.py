"""Ablations: every arrow of a model and of its guide left out in turn, and what each is worth.

Two prices, which answer two questions. On linear-Gaussian twins (`dvae.program.oracle`) it is computed: the
evidence that a model loses without an arrow, and how much wider the gap of a guide becomes. It says which arrows can
matter. On data it is measured: the whole and every reduced pair of equations are fitted with the same seeds (`sweep`)
and compared on the test windows (`compare`), with errors over clips and seeds, and p-values for all arrows at once
(Holm, 1979).

Both prices are of the same: of a model's arrow the evidence, on data the importance-weighted bound, which is near it
whatever the guide; of a guide's arrow the evidence lower bound, from which an importance-weighted one is made to hide
how far the guide is from the posterior.

All pairs are fitted with networks of one kind (the method `equations`), as those of a paper are made for its arrows:
SRNN's three factors share the state of x_{<t}, and none of them could do without it alone.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import networkx as nx
import numpy as np
from typing_extensions import override

from ..data.schema import Schema
from ..data.sequences import called
from ..factorization.drawing import draw_slice
from ..factorization.notation import Factorization, Parent, check_pair
from ..inference.evaluation.compare import compare
from ..inference.evaluation.comparison import Comparison
from ..inference.evaluation.estimates import Estimate, number
from ..inference.evaluation.record import Dims
from ..inference.evaluation.result import Result, Table, canvas, progress_bar
from ..inference.training.checkpoints import ENDED
from ..inference.training.many import holm
from ..inference.training.options import Training
from ..models.family.equations import Equations
from ..models.method import Method
from ..program.oracle import model_price, ones, price
from .directory import load, training_of
from .kinds import Dataset
from .sweep import sweep

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METRIC = {"p": "importance bound", "q": "ELBO"}
"""By which arrows of a model, and of a guide, are priced on data."""
WHOLE = "whole"
"""The run of all arrows."""
FAMILY = ("vae", "dkf", "storn", "vrnn", "srnn", "rvae-causal", "rvae-noncausal", "dsae", "autoregressive")
"""Methods that are their equations, which networks of one kind can have."""
LEVEL = 0.05
"""From which p-value on an arrow is drawn pale."""
MOST = 1000
"""Random models of an ablation that is read from a file."""
WORDS = {"<=": "upto-", ">=": "from-", "<": "before-", ">": "after-", ":": ".."}
"""In names of directories, which have none of these signs."""


@dataclass(frozen=True)
class Arrow:
    """An arrow of a model or of its guide.

    Args:
        kind: "p" of the model, "q" of the guide.
        child: the variable that reads.
        parent: what it reads.
        name: such as "x_{<t} to z_t".
    """

    kind: Literal["p", "q"]
    child: str
    parent: Parent
    name: str

    @property
    def of(self) -> str:
        """What it is an arrow of, in a word."""
        return {"p": "model", "q": "guide"}[self.kind]

    @property
    def run(self) -> str:
        """What is fitted without it, such as "guide-without-x_before-t-to-z_t"."""
        name = self.name.replace("{", "").replace("}", "").replace(" ", "-")
        for sign, word in WORDS.items():
            name = name.replace(sign, word)
        return f"{self.of}-without-{name}"


@dataclass(frozen=True, eq=False, repr=False)
class Ablation(Result):
    """What every arrow of a model and its guide is worth.

    Attributes:
        equations: "generative" and "inference".
        sizes: of the variables of the twins.
        steps: T of the twins.
        prices: by `Arrow.run`, the price in each of the twins, in nats a sequence.
        notes: by `Arrow.run`, what keeps an arrow from being left out on data, or what becomes of the rest without it.
        comparison: of the fitted models, `WHOLE` and those by `Arrow.run`; None where none were fitted.

    Example:
        >>> found = dvae.ablate(("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})"), steps=3, twins=2)
        >>> [arrow.name for arrow in found.arrows if max(found.prices[arrow.run]) < 1e-6]
        ['x_{<t} to z_t']
    """

    equations: dict[str, str]
    sizes: dict[str, int]
    steps: int
    prices: Annotated[dict[str, np.ndarray], Dims("twin", name="{}")]
    notes: dict[str, str]
    comparison: Comparison | None = None

    @cached_property
    def _pair(self) -> tuple[Factorization, Factorization]:
        return Equations(generative=self.equations["generative"], inference=self.equations["inference"]).equations()

    @property
    def generative(self) -> Factorization:
        """The model."""
        return self._pair[0]

    @property
    def inference(self) -> Factorization:
        """Its guide."""
        return self._pair[1]

    @property
    def arrows(self) -> tuple[Arrow, ...]:
        """Of the model and of the guide, each the dearest on the twins first."""
        found = arrows_of(self.generative, self.inference)
        return tuple(sorted(found, key=lambda arrow: (arrow.kind, -float(np.mean(self.prices[arrow.run])))))

    @cached_property
    def differences(self) -> dict[str, Estimate]:
        """By `Arrow.run`, what the whole has above that without the arrow, by its `METRIC`, in nats a frame."""
        if self.comparison is None:
            return {}
        fitted = [arrow for arrow in self.arrows if arrow.run in self.comparison.rows]
        return {arrow.run: self.comparison.difference(WHOLE, arrow.run, METRIC[arrow.kind]) for arrow in fitted}

    @property
    def p_values(self) -> dict[str, float]:
        """By `Arrow.run`, of no difference, for all arrows at once; NaN of one seed or one clip."""
        adjusted = holm([estimate.p_value() for estimate in self.differences.values()])
        return dict(zip(self.differences, map(float, adjusted), strict=True))

    def table(self) -> Table:
        """A line for each arrow."""
        sizes = ", ".join(f"{name} {size}" for name, size in self.sizes.items())
        twins = len(next(iter(self.prices.values()), ()))
        lines = [
            f"twin: mean (least to largest) of {twins} linear-Gaussian models of {self.steps} steps, sizes {sizes};",
            "of the model the evidence lost, of the guide the gap that is wider, in nats a sequence",
        ]
        if self.comparison is not None:
            lines += [
                f"fitted: what the whole has more, of the model in the bound of K = {self.comparison.particles}, of "
                f"the guide in the ELBO, in nats a {self._frame},",
                "± standard errors over clips ± over seeds; 95 % from both; p: for all arrows at once (Holm)",
            ]
        table = Table(title=f"{self.generative.text}\n{self.inference.text}".strip(), caption="\n".join(lines))
        columns = ("fitted", "95 %", "p") if self.comparison is not None else ()
        for name in ("arrow", "of", "twin", *columns, *(["note"] if self.notes else [])):
            table.add_column(name, justify="right" if name in ("twin", *columns) else "left", overflow="fold")
        for arrow in self.arrows:
            costs = np.array(self.prices[arrow.run])
            cells = [f"{number(costs.mean())} ({number(costs.min())} to {number(costs.max())})"]
            if columns and (found := self.differences.get(arrow.run)) is not None:
                low, high = map(number, found.interval())
                cells += [str(found), low if low == "–" else f"{low} to {high}", number(self.p_values[arrow.run])]
            elif columns:
                cells += ["–"] * 3
            table.add_row(arrow.name, arrow.of, *cells, *([self.notes.get(arrow.run, "")] if self.notes else []))
        return table

    def plot(self) -> Figure:
        """Model and guide of one step, arrows as thick as their price: on twins and, where there are fits, on data."""
        parts = [part for part in (self.generative, self.inference) if part.factors]
        on_twins = {run: float(np.mean(costs)) for run, costs in self.prices.items()}
        rows: list[tuple[str, dict[str, float], set[str]]] = [("nats a sequence, on twins", on_twins, set())]
        if self.comparison is not None:
            fitted = {run: estimate.mean for run, estimate in self.differences.items()}
            unsure = {run for run, p in self.p_values.items() if not p < LEVEL}
            rows.append((f"nats a {self._frame}, on data\n(pale: p ≥ {LEVEL})", fitted, unsure))
        figure = canvas(5 * len(parts), 3.6 * len(rows))
        panels = figure.subplots(len(rows), len(parts), squeeze=False)
        for (unit, costs, pale), row in zip(rows, panels, strict=True):
            top = max(costs.values(), default=0.0)
            for part, panel in zip(parts, row, strict=True):
                graph = part.slice(self.observed)
                runs = {edge[:2]: arrow_of(part, *edge[2]).run for edge in graph.edges.data("arrow")}
                of_edges = {edge: costs[run] for edge, run in runs.items() if run in costs}
                draw_slice(graph, of_edges, panel, top, [edge for edge, run in runs.items() if run in pale])
                panel.set_title(f"{'model' if part.kind == 'p' else 'guide'}: {unit}", fontsize=10)
        return figure

    @property
    def _frame(self) -> str:
        """What bounds are per."""
        return called(self.comparison.data)[1] if self.comparison is not None else ""

    @property
    def observed(self) -> tuple[str, ...]:
        """What the model draws and the guide does not."""
        return tuple(name for name in self.generative.variables if name not in self.inference.variables)

    @override
    def summary(self) -> dict[str, Any]:
        differences = {run: vars(estimate) for run, estimate in self.differences.items()}
        return {"differences": differences, "p_values": self.p_values}

    @override
    def check(self) -> None:
        runs = {arrow.run for arrow in arrows_of(self.generative, self.inference)}
        fitted = set() if self.comparison is None else self.comparison.rows.keys() - {WHOLE}
        if self.prices.keys() != runs or not runs >= self.notes.keys() | fitted:
            raise ValueError("prices, notes or fits name other edges than those of the equations")
        counts = {len(costs) for costs in self.prices.values()}
        if len(counts) > 1 or not all(0 < count <= MOST for count in counts):
            raise ValueError(f"every arrow has a price in each of the same 1 to {MOST} random models")
        if not all(np.isfinite(costs).all() for costs in self.prices.values()):
            raise ValueError("a price is finite")
        if self.comparison is not None:
            self.comparison.check()
        self.table()  # of a comparison that has the whole and all that its table needs


def arrows_of(generative: Factorization, inference: Factorization) -> tuple[Arrow, ...]:
    """Every arrow of a model and of its guide."""
    return tuple(arrow_of(part, *arrow) for part in (generative, inference) for arrow in part.arrows)


def arrow_of(part: Factorization, child: str, parent: Parent) -> Arrow:
    """One of them."""
    return Arrow(part.kind, child, parent, part.arrow(child, parent))


def as_equations(method: Method | tuple[str, str], schema: Schema | None = None) -> Equations:
    """A method as equations with networks of one kind, its options where these have them.

    Args:
        method: one of `FAMILY`, `equations`, or a pair of equations (generative, inference).
        schema: of the data, whose covariates factors read as those of the method do.

    Raises:
        ValueError: a method that is more than its equations.
    """
    if isinstance(method, tuple):
        generative, inference = method
        return Equations(generative=generative, inference=inference)
    if isinstance(method, Equations):
        if method.states:
            raise ValueError(
                f"{', '.join(method.states)} is summed out, and twins with states have no price that is known; fit the "
                "reduced equations by a sweep (--grid), and compare them"
            )
        return method
    if method.name not in FAMILY:
        raise ValueError(
            f"{method.name} is more than its equations, with networks that are made for the arrows it has; an ablation "
            f"is of {', '.join(FAMILY)}, which are fitted with networks of one kind, or of equations: "
            "dvae.method('equations', generative=…, inference=…)"
        )
    covariates = ((), ()) if schema is None else schema.covariates
    pair = [part.given(*covariates, getattr(method, "apart", ())) for part in method.equations()]
    known = {option.name for option in fields(Equations)} - {"generative", "inference", "latents"}
    options = {name: value for name, value in vars(method).items() if name in known and value is not None}
    sizes = {name: size for name, size in method.sizes().items() if size != options.get("latent")}
    return Equations(generative=pair[0].text, inference=pair[1].text, latents=sizes, **options)


def ablate(
    method: Method | tuple[str, str],
    data: Dataset | None = None,
    out: str | os.PathLike[str] | None = None,
    seeds: Sequence[int] = (0, 1, 2),
    training: Training | Mapping[str, Any] | None = None,
    jobs: int = 2,
    *,
    observed: Sequence[str] = ("x",),
    sizes: Mapping[str, int] | None = None,
    steps: int = 5,
    twins: int = 5,
    bound_particles: int = 64,
    seed: int = 0,
    progress: bool = True,
) -> Ablation:
    """Prices every arrow of a model and of its guide, left out in turn: on linear-Gaussian twins, and on data.

    Without data it is the twins alone. With data, one run for the whole and one for each arrow are fitted with each
    seed, and compared on the test windows. The same call again continues what was stopped, and leaves finished runs as
    they are. A model without one of its arrows keeps the guide that is written; a guide that is "faithful" is derived
    anew.

    Args:
        method: one of vae, dkf, storn, vrnn, srnn, rvae-causal, rvae-noncausal, dsae and autoregressive, whose
            equations are fitted with networks of one kind; `equations`; or a pair of equations (generative,
            inference), with the options that `equations` has by default.
        data: with windows to train, validate and test on, such as `dvae.motion.MotionData` or `dvae.tables.PanelData`.
        out: where the run directories go.
        seeds: of the runs of each arrow.
        training: options of the runs, or some of them beside those of `equations`.
        jobs: runs at a time.
        observed: names of the observed variables where there are no data, which else name them.
        sizes: of the variables of the twins; by default 2 of data and 1 of others.
        steps: T of the twins.
        twins: random models on which arrows are priced.
        bound_particles: of the importance-weighted bound.
        seed: of the draws of that bound.
        progress: whether to show a progress bar.

    Raises:
        ValueError: a method that is more than its equations; data without `out`; a latent that the guide
            does not draw; as `sweep`, `price` and `compare`.
        RuntimeError: a run has failed; the same call tries it again.
        SweepInterrupted: after Ctrl-C or SIGTERM.

    Example:
        >>> found = dvae.ablate(("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})"), steps=3, twins=1)
        >>> len(found.arrows), found.arrows[-1].of, found.arrows[-1].name
        (6, 'guide', 'x_{<t} to z_t')
    """
    if (data is None) != (out is None):
        raise ValueError("fits need data, and a directory for their runs: give both `data` and `out`, or none of them")
    whole = as_equations(method, None if data is None else data.schema)
    model, read = whole.equations()
    if data is None:
        check_pair(model, read, observed)
    observed = tuple(name for name in model.variables if name not in read.variables)
    known = dict(sizes or {**ones(model, read), **dict.fromkeys(observed, 2)})
    arrows = arrows_of(model, read)
    parts = {"p": model, "q": read}
    less = {arrow: parts[arrow.kind].without(arrow.child, arrow.parent) for arrow in arrows}

    of_twins = known, steps, twins, observed
    prices: dict[str, np.ndarray] = {}
    with progress_bar(progress) as bar:
        gaps = price(model, read, *of_twins)
        for arrow in bar.track(arrows, description="prices on twins"):
            if arrow.kind == "p":
                costs = model_price(model, less[arrow], *of_twins)
            else:
                costs = price(model, less[arrow], *of_twins) - gaps
            prices[arrow.run] = costs.numpy()

    notes = {
        arrow.run: f"no data depend on {', '.join(sorted(idle))} then"
        for arrow in arrows
        if arrow.kind == "p" and (idle := _idle(less[arrow], observed) - _idle(model, observed))
    }
    found = Ablation({"generative": model.text, "inference": read.text}, known, steps, prices, notes)
    if data is None or out is None:
        return found
    named: dict[str, Method] = {WHOLE: whole}
    whole.build(data.schema)
    for arrow in arrows:
        try:
            changed: dict[str, Any] = {"generative" if arrow.kind == "p" else "inference": less[arrow].text}
            reduced = replace(whole, **changed)
            reduced.build(data.schema)
        except ValueError as error:
            notes[arrow.run] = f"not fitted: {error}"
        else:
            named[arrow.run] = reduced
    told = training if isinstance(training, Training) else {"progress": progress, **(training or {})}
    results = sweep(named, data, out, seeds, training_of(whole, data, told), jobs)
    if failed := [str(result) for result in results if result.status not in ENDED]:
        raise RuntimeError(
            "\n".join([f"{len(failed)} of {len(results)} runs failed; the same again tries them anew", *failed])
        )
    comparison = compare(
        {name: [load(Path(out) / f"{name}-seed{each}").model for each in seeds] for name in named},
        data.windows("test"),
        particles=bound_particles,
        contrasts=0,
        samples=0,
        seed=seed,
        configs={name: each.config() for name, each in named.items()},
        progress=progress,
    )
    return replace(found, comparison=comparison)


def _idle(model: Factorization, observed: tuple[str, ...]) -> set[str]:
    """Latents on which no data depend."""
    reads = nx.DiGraph([(parent.name, factor.child) for factor in model.factors for parent in factor.parents])
    reads.add_nodes_from(model.variables)
    return {*model.variables}.difference(observed, *(nx.ancestors(reads, name) for name in observed))
