"""Commands on methods and equations: list and show."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ..factorization.graph import Audit, alternatives, audit
from ..factorization.inversion import guide
from ..factorization.notation import Factorization
from ..inference.evaluation.result import Table, new_figure, styled
from ..models import registry
from ..models.registry import methods, metric_models
from .console import OUT, UsageError, arguments, at_least, check_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..inference.training.options import Training


def list_methods() -> None:
    """List the methods with their equations and sources."""
    table = Table(show_lines=True)
    for column in ("method", "equations", "source"):
        table.add_column(column)
    for name in methods():
        generative, inference, source = methods().texts(name, "generative", "inference", "source")
        pair = "--generative and --inference" if generative is None else f"{generative}\n{inference}"
        table.add_row(name, pair, source)
    for name in metric_models():
        table.add_row(name, "a metric model of forecasts", *metric_models().texts(name, "source"))
    OUT.print(table, highlight=False)


def show(
    method: Annotated[str | None, tyro.conf.Positional] = None,
    generative: str | None = None,
    inference: str | None = None,
    steps: int = 4,
    summed: tuple[str, ...] = (),
    out: Path | None = None,
) -> None:
    """Show two equations: the joint distributions, the audit of the guide, and the graph; and a method's defaults.

    Args:
        method: name of a method or of a metric model, unless equations are given.
        generative: equation of the model, such as "p(z_t | z_{t-1}) p(x_t | z_t)"; without --inference, lists the
            guides that ignore no dependency of the posterior.
        inference: equation of the guide, such as "q(z_t | z_{t-1}, x_{t:T})"; "faithful" for a guide that ignores no
            dependency of the posterior, "" for a model without latents.
        steps: number of time steps in the figure.
        summed: discrete latents of the model that are summed out; the guide has no factor for them.
        out: save the unrolled graphs of model and guide to this file (png, pdf, svg).
    """
    at_least(1, steps=steps)
    check_figure(out, "out")
    if method is not None and (generative or inference or summed):
        raise UsageError("give the name of a method or two equations, not both")
    if method is not None and method in metric_models():
        if out is not None:
            raise UsageError(f"{method} is a metric model and has no graph; leave out --out")
        metric_model = metric_models()[method]
        lines = [
            f"{method} has no equations: it is a metric model of forecasts ({metric_model.source})",
            *_describe_trainings(metric_model.trainings),
        ]
        OUT.print("\n".join(lines), highlight=False, soft_wrap=True)
        return
    if method is not None:
        with arguments():
            kind = registry.method(method)
        if _asks_for_equations(kind):
            raise UsageError(f"{method} has no equations of its own; give --generative and --inference")
        from ..program.enumeration import Discrete  # imports torch

        pair = kind.equations()
        summed = tuple(name for name, size in kind.sizes().items() if isinstance(size, Discrete))
        observed = [name for name in pair[0].variables if name not in (*pair[1].variables, *summed)]
    elif generative and inference is None:
        with arguments():
            choice = alternatives(generative, summed=summed)
        OUT.print(str(choice.generative), highlight=False, markup=False, soft_wrap=True)
        OUT.print(choice.table())
        return
    elif generative:
        with arguments():
            model = Factorization.parse(generative)
            pair = model, guide(model, inference, summed=summed)
        observed = ["x"]
    else:
        raise UsageError("give the name of a method, or --generative, with --inference for the audit of a guide")
    with arguments():
        pair_audit = audit(*pair, observed=observed, summed=summed)
    if out is not None:
        save_figure(_drawing(pair_audit, steps, observed), out)
    OUT.print(str(pair_audit.generative), highlight=False, markup=False, soft_wrap=True)
    if pair_audit.inference.factors:
        OUT.print(str(pair_audit.inference), highlight=False, markup=False, soft_wrap=True)
        OUT.print(pair_audit.table())
        OUT.print(pair_audit.verdict)
    else:
        reason = "all latents are summed out" if summed else "the model has no latents"
        OUT.print(f"{reason}: there is no guide, and the bound is the log evidence if the density of x is exact")
    if method is not None:
        OUT.print("\n".join(_describe_trainings(kind.trainings)), highlight=False, soft_wrap=True)


@styled
def _drawing(pair_audit: Audit, steps: int, observed: Collection[str]) -> Figure:
    """Draw the model and, if there is one, the guide."""
    graphs = 2 if pair_audit.inference.factors else 1
    figure = new_figure(graphs * (0.85 * steps + 1.6), 3 if graphs == 2 else 1.6)
    model, *guides = figure.subplots(1, graphs, squeeze=False)[0]
    pair_audit.generative.draw(steps, ax=model, observed=observed).set_title("model")
    for axes in guides:
        ignored = "" if pair_audit.exact else "\ndashed: dependencies of the exact\nposterior that the guide ignores"
        pair_audit.draw(steps, ax=axes).set_title(f"guide{ignored}")
    return figure


def _describe_trainings(trainings: Mapping[str, Training]) -> list[str]:
    """Return the training defaults of a method by skeleton, in words."""
    lines = []
    for skeleton, training in trainings.items():
        rate = training.rate
        ends = "" if rate(0) == rate(training.steps) else f" that falls to {rate(training.steps):g}"
        on = f" for {skeleton}" if skeleton else " for other data" if len(trainings) > 1 else ""
        lines.append(
            f"training defaults{on}: {training.steps} steps, batches of {training.batch_size}, {training.optimizer}, "
            f"learning rate {rate(0):g}{ends}"
        )
    return lines


def _asks_for_equations(kind: Any) -> bool:
    """Return whether the equations of a method are given as options."""
    return "generative" in {option.name for option in fields(kind)}
