"""The exact bound of a linear-Gaussian model and guide by dense Gaussian algebra, independent of the library.

Every value is an affine function of the guide's noise e ~ N(0, I): a tensor (E + 1, D) of coefficients, the constant
last. The mean of its square is the sum of the squared coefficients, so that the bound and its gradient, by automatic
differentiation, are exact. Missing and fed values are the mean given their parents.
"""

from contextlib import ExitStack
from dataclasses import replace
from unittest import mock

import networkx as nx
import numpy as np
import torch

from dvae.distributions import ConditionalDistribution
from dvae.factorization.notation import Factorization
from dvae.factorization.relations import Relation
from dvae.inference.bounds.elbo import SequenceELBO
from dvae.program.conditional import CONSTANT


def exact_bound(model, x, *, length=None, seen=None, fed=None, detach=False):
    """Return the bound of one sequence of shape (T, D), whose first `length` steps are data.

    Args:
        seen: mask of observed entries, (T, D).
        fed: mask of history frames that are the model's mean, (T,).
        detach: whether fed frames carry no gradient; missing values always do.
    """
    padded, width = x.shape
    length = padded if length is None else length
    seen = torch.ones(padded, width, dtype=torch.bool) if seen is None else seen
    fed = torch.zeros(padded, dtype=torch.bool) if fed is None else fed
    counts = {name: (length if model.generative.local(name) else 1) * model.sizes[name] for name in model.latents}
    noise = sum(counts.values())

    def constant(value):
        return torch.cat([value.new_zeros(noise, value.shape[-1]), value[None]])

    def evaluate(factorization, conditionals, values, make):
        """Visit the unrolled graph, parents first; `make` gets the mean and scale of each node."""
        for name, t in nx.topological_sort(factorization.dag(padded)):
            if name not in factorization.variables:
                continue
            if t is not None and t > length:
                values[name, t] = x.new_zeros(noise + 1, model.sizes[name])
                continue
            network, factor = conditionals[name].network, factorization.factor(name)
            row = 0 if t is None else t - 1
            size = model.sizes[name]
            if network is None:  # N(0, I)
                make(name, t, constant(x.new_zeros(size)), x.new_ones(size))
                continue
            mean = constant(network.bias[row])
            if not factor.parents:  # a guide's network then reads a constant
                mean = constant(network.bias[row] + network.weights[CONSTANT][row, 0, :, 0])
            for parent in factor.parents:
                for column in np.flatnonzero(factorization.mask(name, parent.name, padded)[row]):
                    value = values[parent.name, column + 1 if parent.local else None]
                    mean = mean + value @ network.weights[parent.name][row, column].T
            log_scale = conditionals[name].head.log_scale
            make(name, t, mean, (log_scale if log_scale.dim() == 1 else log_scale[row]).exp())

    bound = x.new_zeros(())
    n_used = 0
    observed = {("x", t + 1): constant(torch.where(seen[t], x[t], 0.0)) for t in range(padded)}
    observed |= {("x", t + 1): x.new_zeros(noise + 1, width) for t in range(length, padded)}
    values_by_node = dict(observed)

    def draw(name, t, mean, scale):
        nonlocal bound, n_used
        size = len(scale)
        value = mean.clone()
        value[n_used : n_used + size] += torch.diag(scale)
        n_used += size
        bound = bound + (0.5 + scale.log() + 0.5 * np.log(2 * np.pi)).sum()  # - E log q
        values_by_node[name, t] = value

    evaluate(model.inference, model.encoder, values_by_node, draw)
    history = {node: value for node, value in values_by_node.items() if node[0] != "x"}

    def score(name, t, mean, scale):
        nonlocal bound
        value = observed["x", t] if name == "x" else values_by_node[name, t]
        squares = ((value - mean) / scale).square().sum(0)
        entries = -0.5 * squares - scale.log() - 0.5 * np.log(2 * np.pi)
        mask = seen[t - 1] if name == "x" else torch.ones_like(entries, dtype=torch.bool)
        bound = bound + torch.where(mask, entries, 0.0).sum()
        if name == "x":
            model_mean = torch.where(seen[t - 1], mean.detach() if detach else mean, mean)
            value = torch.where(~seen[t - 1] | fed[t - 1], model_mean, value)
        history[name, t] = value

    evaluate(model.generative, model.generator, history, score)
    assert n_used == noise
    return bound


def library_bound(model, x, *, lengths=None, seen=None, fed=None, feeding=None):
    """Return the library's bound (B,), averaged exactly over its noise, in which it is quadratic.

    Draws at plus and minus the root of E along every axis have the mean and covariance of N(0, I).
    """
    batch, padded = x.shape[:2]
    noise = sum(model.sizes[name] * (padded if model.generative.local(name) else 1) for name in model.latents)
    axes = noise**0.5 * torch.eye(noise, dtype=x.dtype)
    points = torch.cat([axes, -axes]).repeat_interleave(batch, 0)
    rows = {"x": x.repeat(2 * noise, 1, 1)}
    if seen is not None:
        rows["mask"] = seen.repeat(2 * noise, 1, 1)
    if lengths is not None:
        rows["lengths"] = torch.as_tensor(lengths).repeat(2 * noise)
    n_used = 0

    def take(shape, *_, **__):
        nonlocal n_used
        width = int(np.prod(shape[1:]))
        n_used += width
        return points[:, n_used - width : n_used].reshape(shape)

    with ExitStack() as patched:
        patched.enter_context(
            mock.patch.object(ConditionalDistribution, "noise", lambda self, shape, like: take(shape))
        )
        patched.enter_context(mock.patch("torch.distributions.normal._standard_normal", take))
        if fed is not None:  # frames with 0 are fed, those with 1 are not
            frames = (~fed).to(x.dtype).repeat(2 * noise, 1)[..., None]
            patched.enter_context(mock.patch("torch.rand", return_value=frames))
        terms = SequenceELBO().terms(model, rows, scheduled_sampling=feeding)
    assert n_used == noise
    return terms.bound.unflatten(0, (2 * noise, batch)).mean(0)


def masked(text, rng, share):
    """Return the equations with random custom masks, either square or with equal rows."""
    equations = Factorization.parse(text)

    def cut(factor, parent):
        if parent.relation is None or rng.random() > share:
            return parent
        square, row = rng.random((8, 8)) < 0.6, rng.random((1, 8)) < 0.6
        if not factor.local:
            return replace(parent, relation=Relation.custom("row", lambda T: resized(row, T)))
        shape = row if rng.random() < 0.3 else square
        return replace(parent, relation=parent.relation & Relation.custom("own", lambda T: resized(shape, T)))

    factors = [replace(f, parents=tuple(cut(f, parent) for parent in f.parents)) for f in equations.factors]
    return Factorization(equations.kind, tuple(factors))


def resized(mask, T):
    """Return a mask of any length by periodic repetition."""
    rows, columns = (np.arange(T) % n for n in mask.shape)
    return mask[np.ix_(rows[: T if len(mask) > 1 else 1], columns)]
