"""Command that leaves out arrows: ablate."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ..factorization.inversion import FAITHFUL
from ..models import registry
from ..models.family.equations import Equations
from ..models.method import LatentMethod
from ..runs.ablation import ablate as ablate_method
from ..runs.ablation import as_equations
from .console import ERROR, OUT, UsageError, arguments, at_least, check_figure, save_figure
from .fitting import DataOptions, MethodOptions, SweepOptions, given_options, options_of

if TYPE_CHECKING:
    EquationOptions = Any
else:
    SHARED = [option.name for option in fields(LatentMethod)]
    EquationOptions = options_of("EquationOptions", Equations, "generative", "inference", *SHARED)


def ablate(
    method: Annotated[str | None, tyro.conf.Positional] = None,
    *,
    model: MethodOptions,
    networks: EquationOptions,
    training: SweepOptions,
    source: DataOptions,
    generative: str | None = None,
    inference: str | None = None,
    latent: int | None = None,
    out: Path | None = None,
    seeds: tuple[int, ...] = (0, 1, 2),
    jobs: int = 2,
    bound_particles: int = 64,
    twin_steps: int = 5,
    twins: int = 5,
    figure: Path | None = None,
) -> None:
    """Leave out every arrow of a model and its guide in turn: what each is worth on linear-Gaussian twins, and on data.

    Without --out it is computed on the twins alone. With --out every reduced pair of equations is fitted too, with
    networks of one kind, and compared on the test windows; the table, with all that it rests on, goes to ablation.json
    there. The same command continues what was stopped, and leaves finished runs as they are.

    Args:
        method: name of a method, or give --generative instead.
        model: options of all models, in place of the method's.
        networks: of every factor, and what they make.
        training: options of the runs.
        source: the data.
        generative: the model, such as "p(z_t | z_{t-1}) p(x_t | z_t)".
        inference: the guide, such as "q(z_t | z_{t-1}, x_{t:T})"; by default "faithful", one that misses nothing,
            derived anew for every reduced model; "" of a model without latents.
        latent: size of the latents.
        out: directory of the run directories, whole-seed0 and such as model-without-z_t-1-to-z_t-seed0.
        seeds: of initial weights, batches and draws, a run for each.
        jobs: runs at a time.
        bound_particles: of the importance-weighted bound, K.
        twin_steps: time steps of the twins.
        twins: random linear-Gaussian models on which arrows are priced.
        figure: save model and guide of one step, arrows as thick as their price.
    """
    at_least(1, jobs=jobs, bound_particles=bound_particles, twin_steps=twin_steps, twins=twins)
    check_figure(figure, "figure")
    if (method is None) == (generative is None):
        raise UsageError("give the name of a method, or --generative, with --inference for a guide of your own")
    if method is not None and inference is not None:
        raise UsageError(f"--inference is the guide of --generative; {method} has its own")
    trained = [value for value in vars(training).values() if value not in (None, False)]
    if out is None and (trained or source != DataOptions()):
        raise UsageError("fits need a directory for their runs: give --out DIR")
    if out is not None and (out.is_file() or not seeds):
        raise UsageError(f"give at least one seed, and a directory for the runs: --out {out} --seeds {seeds}")
    with arguments():
        guide = FAITHFUL if inference is None else inference
        named = registry.method(method) if method else Equations(generative=generative or "", inference=guide)
        given = {**vars(model), **vars(networks), "latent": latent}
        chosen = {name: value for name, value in given.items() if value is not None}
        replace(as_equations(named), **chosen).check()
        how = given_options(training)
    opened = None if out is None else source.open(named)
    whole = replace(as_equations(named, None if opened is None else opened.schema), **chosen)
    result = ablate_method(
        whole, opened, out, seeds, how, jobs, steps=twin_steps, twins=twins, bound_particles=bound_particles
    )
    if out is not None:
        result.save(out / "ablation.json")
        ERROR.print(f"wrote {out / 'ablation.json'}")
    if figure is not None:
        save_figure(result.plot(), figure)
    OUT.print(result.table())
