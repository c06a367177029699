"""Ablations: remove every edge of a model and of its guide in turn, and measure the cost of each.

There are two costs. On linear-Gaussian surrogates (`dvae.program.oracle`) the cost is computed: the evidence that a
model loses without an edge, or the increase of the gap of a guide. It shows which edges can matter. On data the cost is
measured. The full pair of equations and every reduced pair are fitted with the same seeds (`sweep`). They are compared
on the test windows (`compare`), with errors over clips and seeds, and p-values adjusted for all edges (Holm, 1979).

The cost of a model's edge is a loss of evidence. On data it is measured by the IWAE bound, which is near the evidence
even if the guide is not. The cost of a guide's edge is a loss of the ELBO, because an IWAE bound hides the distance of
the guide from the posterior.

All pairs are fitted with networks of one kind (the method `equations`), because the networks of a paper are designed
for its edges. For example, SRNN's three factors share the state of x_{<t}, so that it cannot be removed from one alone.
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
from ..data.sequences import axis_names
from ..factorization.drawing import draw_slice
from ..factorization.notation import Factorization, Parent, check_pair
from ..inference.evaluation.compare import compare
from ..inference.evaluation.comparison import Comparison
from ..inference.evaluation.estimates import Estimate, number
from ..inference.evaluation.multiple_comparisons import holm
from ..inference.evaluation.record import Dims
from ..inference.evaluation.result import Result, Table, new_figure, progress_bar, styled
from ..inference.training.options import Training
from ..models.family.equations import Equations
from ..models.method import Method
from ..program.oracle import kl_gap, model_kl_gap, ones
from .directory import load, training_of
from .kinds import Dataset
from .sweep import require_ended, sweep

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METRIC = {"p": "IWAE bound", "q": "ELBO"}
"""Bound that measures the cost of edges of a model ("p") and of a guide ("q") on data."""
WHOLE = "whole"
"""Name of the run with all edges."""
FAMILY = ("vae", "dkf", "storn", "vrnn", "srnn", "rvae-causal", "rvae-noncausal", "dsae", "autoregressive")
"""Methods that their equations define completely, so their factors can have networks of one kind."""
LEVEL = 0.05
"""Edges with this p-value or a larger one are drawn pale."""
MOST = 1000
"""Maximum number of surrogates of an ablation read from a file."""
WORDS = {"<=": "upto-", ">=": "from-", "<": "before-", ">": "after-", ":": ".."}
"""Replacements of signs in directory names."""


@dataclass(frozen=True)
class AblatedEdge:
    """An edge of a model or of its guide.

    Args:
        kind: "p" for the model, "q" for the guide.
        child: variable that reads the parent.
        parent: parent with its relation in time.
        name: name of the edge, such as "x_{<t} to z_t".
    """

    kind: Literal["p", "q"]
    child: str
    parent: Parent
    name: str

    @property
    def of(self) -> str:
        """Owner of the edge: "model" or "guide"."""
        return {"p": "model", "q": "guide"}[self.kind]

    @property
    def run(self) -> str:
        """Name of the run without the edge, such as "guide-without-x_before-t-to-z_t"."""
        name = self.name.replace("{", "").replace("}", "").replace(" ", "-")
        for sign, word in WORDS.items():
            name = name.replace(sign, word)
        return f"{self.of}-without-{name}"


@dataclass(frozen=True, eq=False, repr=False)
class Ablation(Result):
    """Costs of every edge of a model and its guide.

    Attributes:
        equations: equations of the model, "generative", and of the guide, "inference".
        sizes: sizes of the variables of the surrogates.
        steps: number T of time steps of the surrogates.
        costs: dictionary from `AblatedEdge.run` to the cost on each surrogate, in nats per sequence.
        notes: dictionary from `AblatedEdge.run` to the reason why the reduced equations were not fitted, or to the
            latents on which no data depend without the edge.
        comparison: comparison of the fitted models, named `WHOLE` or `AblatedEdge.run`; None without fits.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})"
        >>> ablation = dvae.ablate(pair, steps=3, surrogates=2)
        >>> [edge.name for edge in ablation.edges if max(ablation.costs[edge.run]) < 1e-6]
        ['x_{<t} to z_t']
    """

    equations: dict[str, str]
    sizes: dict[str, int]
    steps: int
    costs: Annotated[dict[str, np.ndarray], Dims("surrogate", name="{}")]
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
    def edges(self) -> tuple[AblatedEdge, ...]:
        """Edges of the model, then of the guide, in decreasing order of cost on the surrogates."""
        edges = edges_of(self.generative, self.inference)
        return tuple(sorted(edges, key=lambda edge: (edge.kind, -float(np.mean(self.costs[edge.run])))))

    @cached_property
    def differences(self) -> dict[str, Estimate]:
        """Dictionary from `AblatedEdge.run` to the loss of the `METRIC` without the edge, in nats per frame."""
        if self.comparison is None:
            return {}
        fitted_edges = [edge for edge in self.edges if edge.run in self.comparison.rows]
        return {edge.run: self.comparison.difference(WHOLE, edge.run, METRIC[edge.kind]) for edge in fitted_edges}

    @property
    def p_values(self) -> dict[str, float]:
        """Dictionary from `AblatedEdge.run` to the p-value of the difference, adjusted for all edges (Holm).

        A p-value is NaN with a single seed or clip.
        """
        adjusted = holm([estimate.p_value() for estimate in self.differences.values()])
        return dict(zip(self.differences, map(float, adjusted), strict=True))

    def table(self) -> Table:
        """Return a table with a line for each edge."""
        sizes = ", ".join(f"{name} {size}" for name, size in self.sizes.items())
        surrogates = len(next(iter(self.costs.values()), ()))
        lines = [
            f"surrogate: mean (least to largest) of {surrogates} linear-Gaussian models of {self.steps} steps, sizes "
            f"{sizes};",
            "lost evidence of the model, or increase of the gap of the guide, in nats a sequence",
        ]
        if self.comparison is not None:
            lines += [
                f"fitted: loss without the edge, for the model in the IWAE bound with K = {self.comparison.particles}, "
                f"for the guide in the ELBO, in nats a {self._axes[1]},",
                f"± standard errors over {self._axes[0]}s ± over seeds; 95 % from both; p adjusted by Holm",
            ]
        table = Table(title=f"{self.generative.text}\n{self.inference.text}".strip(), caption="\n".join(lines))
        columns = (f"fitted (nats/{self._axes[1]})", "95 %", "p") if self.comparison is not None else ()
        for name in ("edge", "part", "surrogate (nats/sequence)", *columns, *(["note"] if self.notes else [])):
            table.add_column(name, justify="right" if name not in ("edge", "part", "note") else "left", overflow="fold")
        for edge in self.edges:
            costs = np.array(self.costs[edge.run])
            cells = [f"{number(costs.mean())} ({number(costs.min())} to {number(costs.max())})"]
            if columns and (difference := self.differences.get(edge.run)) is not None:
                low, high = map(number, difference.interval())
                cells += [str(difference), low if low == "–" else f"{low} to {high}", number(self.p_values[edge.run])]
            elif columns:
                cells += ["–"] * 3
            table.add_row(edge.name, edge.of, *cells, *([self.notes.get(edge.run, "")] if self.notes else []))
        return table

    @styled
    def plot(self) -> Figure:
        """Draw model and guide of one step, with edges as wide as their cost, on surrogates and, if fitted, on data.

        Returns:
            A matplotlib figure.
        """
        parts = [part for part in (self.generative, self.inference) if part.factors]
        on_surrogates = {run: float(np.mean(costs)) for run, costs in self.costs.items()}
        rows: list[tuple[str, dict[str, float], set[str]]] = [("nats a sequence, on surrogates", on_surrogates, set())]
        if self.comparison is not None:
            measured = {run: estimate.mean for run, estimate in self.differences.items()}
            insignificant = {run for run, p in self.p_values.items() if not p < LEVEL}
            rows.append((f"nats a {self._axes[1]}, on data\n(pale: p ≥ {LEVEL})", measured, insignificant))
        figure = new_figure(3.5 * len(parts), 2.7 * len(rows))
        panels = figure.subplots(len(rows), len(parts), squeeze=False)
        for (unit, costs, pale), row in zip(rows, panels, strict=True):
            top = max(costs.values(), default=0.0)
            for part, panel in zip(parts, row, strict=True):
                graph = part.slice(self.observed)
                runs = {edge[:2]: edge_of(part, *edge[2]).run for edge in graph.edges.data("edge")}
                of_edges = {edge: costs[run] for edge, run in runs.items() if run in costs}
                draw_slice(graph, of_edges, panel, top, [edge for edge, run in runs.items() if run in pale])
                panel.set_title(f"{'model' if part.kind == 'p' else 'guide'}: {unit}")
        return figure

    @property
    def _axes(self) -> tuple[str, str]:
        """Words for a cluster of sequences and for a step, such as "clip" and "frame", of the fitted models' data."""
        return axis_names(self.comparison.data if self.comparison is not None else {})

    @property
    def observed(self) -> tuple[str, ...]:
        """Variables of the model that the guide does not draw."""
        return tuple(name for name in self.generative.variables if name not in self.inference.variables)

    @override
    def summary(self) -> dict[str, Any]:
        differences = {run: vars(estimate) for run, estimate in self.differences.items()}
        return {"differences": differences, "p_values": self.p_values}

    @override
    def check(self) -> None:
        runs = {edge.run for edge in edges_of(self.generative, self.inference)}
        fitted_runs = set() if self.comparison is None else self.comparison.rows.keys() - {WHOLE}
        if self.costs.keys() != runs or not runs >= self.notes.keys() | fitted_runs:
            raise ValueError(
                "`costs` must name exactly the edges of the equations, and `notes` and fits only these edges"
            )
        counts = {len(costs) for costs in self.costs.values()}
        if len(counts) > 1 or not all(0 < count <= MOST for count in counts):
            raise ValueError(
                f"every edge must have a cost on each of the same 1 to {MOST} surrogates, but the numbers of costs are "
                f"{', '.join(map(str, sorted(counts)))}"
            )
        if not all(np.isfinite(costs).all() for costs in self.costs.values()):
            raise ValueError("costs must be finite")
        if self.comparison is not None:
            self.comparison.check()
        self.table()  # fails if the comparison misses a run or a value


def edges_of(generative: Factorization, inference: Factorization) -> tuple[AblatedEdge, ...]:
    """Return every edge of a model and of its guide."""
    return tuple(edge_of(part, *edge) for part in (generative, inference) for edge in part.edges)


def edge_of(part: Factorization, child: str, parent: Parent) -> AblatedEdge:
    """Return one edge of a model or of its guide."""
    return AblatedEdge(part.kind, child, parent, part.describe_edge(child, parent))


def as_equations(method: Method | tuple[str, str], schema: Schema | None = None) -> Equations:
    """Return a method as `Equations`, with networks of one kind and all options that `Equations` also has.

    Args:
        method: one of `FAMILY`, `equations`, or a pair of equations (generative, inference).
        schema: schema of the data, whose covariates the factors read as in the method.

    Raises:
        ValueError: the method is not defined by its equations alone, or sums out a latent.
    """
    if isinstance(method, tuple):
        generative, inference = method
        return Equations(generative=generative, inference=inference)
    if isinstance(method, Equations):
        if method.states:
            raise ValueError(
                f"{', '.join(method.states)} is summed out, and the cost of an edge is unknown for surrogates with "
                "discrete states; fit the reduced equations with a sweep (--grid), and compare them"
            )
        return method
    if method.name not in FAMILY:
        raise ValueError(
            f"{method.name} is more than its equations: its networks are designed for its edges; ablate one of "
            f"{', '.join(FAMILY)}, which can be fitted with networks of one kind, or equations: "
            "dvae.method('equations', generative=…, inference=…)"
        )
    covariates = ((), ()) if schema is None else schema.covariates
    pair = [part.given(*covariates, getattr(method, "without_covariates", ())) for part in method.equations()]
    option_names = {option.name for option in fields(Equations)} - {"generative", "inference", "latents"}
    options = {name: value for name, value in vars(method).items() if name in option_names and value is not None}
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
    surrogates: int = 5,
    bound_particles: int = 64,
    seed: int = 0,
    progress: bool = True,
) -> Ablation:
    """Return the cost of every edge of a model and of its guide, on linear-Gaussian surrogates and on data.

    Without data, costs are computed on the surrogates only. With data, the full equations and the equations without
    each edge are fitted with each seed, and compared on the test windows. The same call continues interrupted runs and
    keeps finished ones. The guide stays the same if a model loses an edge; only a "faithful" guide is derived anew.

    Args:
        method: one of vae, dkf, storn, vrnn, srnn, rvae-causal, rvae-noncausal, dsae and autoregressive, whose
            equations are fitted with networks of one kind; `equations`; or a pair of equations (generative,
            inference), with the default options of `equations`.
        data: data with training, validation and test windows, such as `dvae.motion.MotionData` or
            `dvae.tables.PanelData`.
        out: directory for the run directories.
        seeds: seeds of the runs of each edge.
        training: all training options of the runs, or those that replace the defaults of `equations`; the bound selects
            the weights.
        jobs: number of runs in parallel.
        observed: names of the observed variables, if there are no data.
        sizes: sizes of the variables of the surrogates; by default 2 for data and 1 for others.
        steps: number T of time steps of the surrogates.
        surrogates: number of random surrogates.
        bound_particles: number of particles of the IWAE bound.
        seed: seed of the draws of the IWAE bound.
        progress: whether to show a progress bar.

    Returns:
        Costs of each edge in nats per sequence on the surrogates and, with data, in nats per frame.

    Raises:
        ValueError: the method is not defined by its equations alone; data without `out`; the guide does not draw a
            latent; as in `sweep`, `kl_gap` and `compare`.
        RuntimeError: a run failed; the same call retries it.
        SweepInterrupted: after Ctrl-C or SIGTERM.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T})"
        >>> ablation = dvae.ablate(pair, steps=3, surrogates=1)
        >>> len(ablation.edges), ablation.edges[-1].of, ablation.edges[-1].name
        (6, 'guide', 'x_{<t} to z_t')
    """
    if (data is None) != (out is None):
        raise ValueError("fits need data and a directory for their runs; give both `data` and `out`, or neither")
    full = as_equations(method, None if data is None else data.schema)
    model, guide = full.equations()
    if data is None:
        check_pair(model, guide, observed)
    observed = tuple(name for name in model.variables if name not in guide.variables)
    surrogate_sizes = dict(sizes or {**ones(model, guide), **dict.fromkeys(observed, 2)})
    edges = edges_of(model, guide)
    parts = {"p": model, "q": guide}
    without = {edge: parts[edge.kind].without(edge.child, edge.parent) for edge in edges}

    surrogate_arguments = surrogate_sizes, steps, surrogates, observed
    costs: dict[str, np.ndarray] = {}
    with progress_bar(progress) as bar:
        gaps = kl_gap(model, guide, *surrogate_arguments)
        for edge in bar.track(edges, description="costs on surrogates"):
            if edge.kind == "p":
                cost = model_kl_gap(model, without[edge], *surrogate_arguments)
            else:
                cost = kl_gap(model, without[edge], *surrogate_arguments) - gaps
            costs[edge.run] = cost.numpy()

    notes = {
        edge.run: f"without it, no data depend on {', '.join(sorted(idle))}"
        for edge in edges
        if edge.kind == "p" and (idle := _idle(without[edge], observed) - _idle(model, observed))
    }
    ablation = Ablation({"generative": model.text, "inference": guide.text}, surrogate_sizes, steps, costs, notes)
    if data is None or out is None:
        return ablation
    methods: dict[str, Method] = {WHOLE: full}
    full.build(data.schema)
    for edge in edges:
        try:
            changes: dict[str, Any] = {"generative" if edge.kind == "p" else "inference": without[edge].text}
            reduced = replace(full, **changes)
            reduced.build(data.schema)
        except ValueError as error:
            notes[edge.run] = f"not fitted: {error}"
        else:
            methods[edge.run] = reduced
    # costs are differences of bounds, so the bound selects the weights
    defaults: dict[str, Any] = {"progress": progress, "select": "bound", "patience": None}
    options = training if isinstance(training, Training) else {**defaults, **(training or {})}
    results = sweep(methods, data, out, seeds, training_of(full, data, options), jobs)
    require_ended(results)
    comparison = compare(
        {name: [load(Path(out) / f"{name}-seed{run_seed}").model for run_seed in seeds] for name in methods},
        data.windows("test"),
        particles=bound_particles,
        contrasts=0,
        samples=0,
        seed=seed,
        configs={name: variant.config() for name, variant in methods.items()},
        progress=progress,
    )
    return replace(ablation, comparison=comparison)


def _idle(model: Factorization, observed: tuple[str, ...]) -> set[str]:
    """Return the latents on which no data depend."""
    reads = nx.DiGraph([(parent.name, factor.child) for factor in model.factors for parent in factor.parents])
    reads.add_nodes_from(model.variables)
    return {*model.variables}.difference(observed, *(nx.ancestors(reads, name) for name in observed))
