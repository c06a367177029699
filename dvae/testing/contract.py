"""FactorizationContract: properties of every model of two factorizations, as tests to subclass.

    class TestMine(dvae.testing.FactorizationContract):
        def build(self, size):
            return dvae.DynamicalVAE(generative, inference, sizes={"z": size, "x": size}, network=MyNetwork())

pytest collects the subclass and runs every test below on the model, in double precision and on random data. The test
that trains the model uses single precision and the data of `FactorizationContract.data`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from pyro import poutine
from pyro.infer import Trace_ELBO
from torch import Tensor

from ..factorization.graph import audit
from ..inference.bounds.annealing import annealed_bound
from ..inference.bounds.elbo import SequenceELBO
from ..inference.training.checkpoints import load_weights, save_weights
from ..inference.training.fit import fit
from ..program.batch import AnyBatch, repeat
from ..program.conditional import Conditional
from ..program.model import DynamicalVAE
from ..program.oracle import Oracle, linear_gaussian_surrogate
from ..program.reference import reference
from .device import SameNoise, move, on_device


class FactorizationContract:
    """Tests of the properties of a `DynamicalVAE`.

    Subclass this class, with a name that pytest collects, and implement `build`.

    Attributes:
        batch: number B of sequences in a test.
        steps: number T of time steps in a test.
        tolerance: maximum difference of log densities between two ways of running the program, in nats.
        still: names of parameters whose gradient may be zero for some batches.
        missing: dependencies of the posterior that the published guide ignores, {} if it is exact; None skips the
            check.
        training_steps: number of optimiser steps in the test that trains.
        waits: maximum number of synchronisations with a GPU in the computation of a bound and its gradient; 1 if only
            the check of the batch synchronises, None to skip the check.
    """

    batch = 3
    steps = 5
    tolerance = 1e-8
    still: frozenset[str] = frozenset()
    missing: Mapping[str, tuple[str, ...]] | None = None
    training_steps = 100
    waits: int | None = None

    def build(self, size: int) -> DynamicalVAE:
        """Return the model under test, which should be small.

        Args:
            size: dimension D of the data and, where free, of the other variables.

        Raises:
            NotImplementedError: a subclass does not implement the method.
        """
        raise NotImplementedError("subclass FactorizationContract and implement build(self, size) to return the model")

    def data(self, size: int) -> AnyBatch:
        """Return sequences to train on, by default sine waves; override it for a model of other data.

        If the distribution of the data has a restricted support, the test uses draws of the model instead.

        Args:
            size: dimension D; for wider data, return the first coordinates.

        Returns:
            x (N, T, D), or a batch.
        """
        start, speed = 6 * torch.rand(2, 24, 1, size)
        return (start + speed * torch.arange(10)[:, None] / 10).sin()

    @pytest.fixture(autouse=True)
    def _seeded(self) -> Iterator[None]:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            yield

    def test_networks_read_the_declared_parents_and_nothing_else(self) -> None:
        """The Jacobian of the parameters at t with respect to a parent at s is exactly zero where the mask is False."""
        model = self._model()
        values = self._data(model, 1, names=model.sizes)
        for conditional in (*model.generator.values(), *model.encoder.values()):
            for name in conditional.parents:
                mask = torch.as_tensor(conditional.factor.mask(name, self.steps))
                dependence = self._reads(conditional, values, name)
                mask = mask.expand_as(dependence)
                assert not (dependence & ~mask).any(), (
                    f"{conditional.factor} reads {name} where its mask is False:\n{dependence}"
                )
                assert (dependence | ~mask).all(), (
                    f"{conditional.factor} does not read {name} where its mask is True:\n{dependence}"
                )

    def test_scoring_agrees_with_drawing(self) -> None:
        """Free-running and teacher-forced log densities of the same values are equal, for model and guide."""
        model = self._model()
        data = self._data(model)
        context = {name: data[name] for name in model.context}
        values, draw_logs = _run(model.model, context, length=self.steps, size=self.batch)
        observations = {**context, **{name: values[name] for name in model.observed}}
        self._close(draw_logs, model.log_joint(observations, {name: values[name] for name in model.latents}))
        latents, draw_logs = _run(model.guide, data)
        self._close(draw_logs, _run(poutine.condition(model.guide, data=latents), data)[1])

    def test_the_log_joint_is_that_of_the_per_step_program(self) -> None:
        """The program and a loop over time with one site per variable and step give equal log densities."""
        model = self._model()
        data = self._data(model)
        latents, _ = _run(model.guide, data)
        sequences = {} if model.sums is None else model.sums.state_sequences(self.steps)
        joints = []
        for index in range(max(map(len, sequences.values()), default=1)):  # every state sequence of discrete latents
            states = {name: value[index].expand(self.batch, *value[index].shape) for name, value in sequences.items()}
            sites: dict[str, Tensor] = {}
            for name, value in (latents | states).items():
                per_step = (
                    {name: value} if value.dim() == 2 else {f"{name}_{t + 1}": v for t, v in enumerate(value.unbind(1))}
                )
                sites |= per_step
            _, logs = _run(poutine.condition(partial(reference, model), data=sites), data)
            joints.append(torch.stack(list(logs.values())).sum(0))
        vectorised = torch.stack(list(model.log_joint(data, latents).values())).sum(0)
        self._close({"joint": torch.stack(joints).logsumexp(0)}, {"joint": vectorised})

    def test_a_sequence_scores_the_same_whatever_is_beside_it(self) -> None:
        """A score does not depend on other sequences, also in training mode, and scoring changes no buffer or mode."""
        model = self._model()
        data = self._data(model)
        latents, _ = _run(model.guide, data)
        model.train()
        buffers = {name: value.clone() for name, value in model.named_buffers()}
        batch_logs = model.log_joint(data, latents)
        first = ({name: value[:1] for name, value in values.items()} for values in (data, latents))
        self._close(model.log_joint(*first), {name: value[:1] for name, value in batch_logs.items()})
        assert model.training
        assert all(torch.equal(value, buffers[name]) for name, value in model.named_buffers())

    def test_every_size_may_be_one(self) -> None:
        """The bound and a forecast are finite for one sequence, one step and one dimension."""
        model = self._model(1)
        data = self._data(model, 1, 2)
        observed = {name: v[:, :1] if name in model.observed else v for name, v in data.items()}
        one = {name: v[:, :1] if v.dim() == 3 else v for name, v in data.items()}
        terms = SequenceELBO().terms(model, one)
        assert terms.bound.shape == (1,)
        assert torch.isfinite(terms.bound).all()
        assert all(torch.isfinite(value).all() for value in model.forecast(observed, 1).values())

    def test_padding_changes_nothing(self) -> None:
        """A sequence in a ragged batch has the same log density as alone, whatever the values at padded steps."""
        model = self._model()
        lengths = torch.arange(self.batch) % self.steps + 1
        data = self._data(model)
        padding = (torch.arange(self.steps) >= lengths[:, None])[..., None]
        ragged = {name: v.masked_fill(padding, torch.nan) if v.dim() == 3 else v for name, v in data.items()}
        ragged["lengths"] = lengths
        latents, guide_logs = _run(model.guide, ragged)
        logs = model.log_joint(ragged, latents)
        for i, n in enumerate(lengths.tolist()):
            sequence, sequence_latents = (
                {name: v[i : i + 1, :n] if v.dim() == 3 else v[i : i + 1] for name, v in values.items()}
                for values in (data, latents)
            )
            self._close(
                {name: log[i : i + 1] for name, log in logs.items()}, model.log_joint(sequence, sequence_latents)
            )
            guided = _run(poutine.condition(model.guide, data=sequence_latents), sequence)[1]
            self._close({name: log[i : i + 1] for name, log in guide_logs.items()}, guided)

    def test_missing_entries_leave_the_likelihood(self) -> None:
        """A mask without missing entries changes no log density; missing data have log-likelihood 0 for any values."""
        model = self._model()
        data = self._data(model)
        latents, guided = _run(model.guide, data)
        names = [name for name in model.observed if self._local(model, name)]
        complete: Any = {**data, "mask": {name: torch.ones_like(data[name], dtype=torch.bool) for name in names}}
        self._close(model.log_joint(complete, latents), model.log_joint(data, latents))
        self._close(_run(poutine.condition(model.guide, data=latents), complete)[1], guided)
        hidden: Any = {**data, **{name: torch.full_like(data[name], torch.nan) for name in names}}
        hidden["mask"] = {name: ~mask for name, mask in complete["mask"].items()}
        terms = SequenceELBO().terms(model, hidden)
        assert torch.isfinite(terms.bound).all()
        assert all((terms.log_likelihood[name] == 0).all() for name in names)

    def test_the_gradient_is_that_of_the_bound(self) -> None:
        """With the same noise, the gradient matches a finite difference of the bound, also if entries are missing."""
        model = self._model()
        data: Any = self._data(model)
        names = [name for name in model.observed if self._local(model, name)]
        data["mask"] = {name: self._mask(model, name, data[name]) for name in names}
        values = [parameter.detach().clone() for parameter in model.parameters()]
        directions = [torch.randn_like(value) for value in values]

        def bound(step: float) -> Tensor:
            with torch.no_grad():
                for parameter, value, direction in zip(model.parameters(), values, directions, strict=True):
                    parameter.copy_(value + step * direction)
            torch.manual_seed(1)
            return SequenceELBO().terms(model, data).bound.sum()

        step = 1e-6
        difference = float((bound(step) - bound(-step)).detach()) / (2 * step)
        gradient = torch.autograd.grad(bound(0.0), list(model.parameters()), allow_unused=True, materialize_grads=True)
        slope = sum(float((g * d).sum()) for g, d in zip(gradient, directions, strict=True))
        assert abs(slope - difference) <= 1e-5 * max(abs(difference), 1.0), (
            f"the gradient gives a slope of {slope}, finite differences give {difference}"
        )

    def test_every_parameter_learns(self) -> None:
        """The loss has a gradient in every parameter of model and guide."""
        model = self._model()
        Trace_ELBO().differentiable_loss(model.model, model.guide, self._data(model)).backward()
        flat = {name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0}
        assert not flat - self.still, f"no gradient reaches {', '.join(sorted(flat - self.still))}"

    def test_a_loaded_model_gives_the_same_seeded_draws(self, tmp_path: Path) -> None:
        """A model that loads saved weights gives the same draws for the same seed as the saved model."""
        model, other = self._model(), self._model()
        save_weights(model, tmp_path / "weights.safetensors")
        load_weights(other, tmp_path / "weights.safetensors")
        data = self._data(model)
        for run in (lambda m: m.guide(data), lambda m: m.reconstruct(data)):
            torch.manual_seed(1)
            expected = run(model)
            torch.manual_seed(1)
            assert all(torch.equal(value, expected[name]) for name, value in run(other).items())

    def test_a_bound_stays_on_its_device(self) -> None:
        """A simulated GPU gives the same bound as the CPU, and a second evaluation copies nothing to the GPU."""
        model = self._model()
        data = self._data(model)
        torch.manual_seed(1)
        expected = SequenceELBO().terms(model, data).bound
        with on_device() as traffic:
            move(model)
            device_data = {name: value.to("cuda") for name, value in data.items()}
            for _ in range(2):  # the first pass copies constants to the device
                traffic.clear()
                torch.manual_seed(1)
                bound = SequenceELBO().terms(model, device_data).bound
                bound.sum().backward()
            assert not traffic.uploads, f"a bound copies tensors to the device: {', '.join(traffic.uploads)}"
            message = f"a bound synchronises {len(traffic.reads)} times with the device: {', '.join(traffic.reads)}"
            assert self.waits is None or len(traffic.reads) <= self.waits, message
            past = {
                name: v[:, :-1] if name in model.observed and v.dim() == 3 else v for name, v in device_data.items()
            }
            model.forecast(past, 1)
            self._close({"bound": bound.detach().cpu()}, {"bound": expected})

    @pytest.mark.gpu
    @pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
    def test_a_bound_on_a_gpu_is_the_processors(self) -> None:
        """With the same noise, a bound and its gradient are equal on GPU and CPU."""
        model = self._model()
        data = self._data(model)
        results: list[dict[str, Tensor]] = []
        for copied, device in ((model, "cpu"), (copy.deepcopy(model).to("cuda"), "cuda")):
            device_data = {name: value.to(device) for name, value in data.items()}
            with SameNoise():
                torch.manual_seed(1)
                bound = SequenceELBO().terms(copied, device_data).bound.sum()
                slopes = torch.autograd.grad(
                    bound, list(copied.parameters()), allow_unused=True, materialize_grads=True
                )
            slope = torch.cat([gradient.flatten().cpu() for gradient in slopes])
            results.append({"bound": bound.detach().cpu(), "its gradient": slope})
        self._close(results[1], results[0])

    def test_the_audit_says_what_is_published(self) -> None:
        """The dependencies of the exact posterior that the guide ignores are exactly those in `missing`."""
        if self.missing is None:
            pytest.skip("missing is None: no published dependencies to compare with")
        model = self.build(1)
        ignored = audit(model.generative, model.inference, observed=model.observed, summed=model.summed).missing
        assert ignored == dict(self.missing), f"the guide ignores {ignored}, expected {dict(self.missing)} (`missing`)"

    def test_its_linear_gaussian_surrogate_is_bounded_by_the_evidence_and_tight_where_the_audit_says_so(self) -> None:
        """On a surrogate with known evidence, the best guide's gap is zero if and only if the guide is exact."""
        model = self._model()
        if model.context:
            pytest.skip("the evidence given a context is unknown")
        if any(parent not in model.summed for name in model.summed for parent in model.generator[name].parents):
            pytest.skip("the evidence is unknown, because states depend on continuous variables")
        # size 1, because a diagonal covariance is then no restriction
        sizes = {name: size if name in model.summed else 1 for name, size in model.sizes.items()}
        pair = linear_gaussian_surrogate(model.generative, model.inference, sizes, self.steps, observed=model.observed)
        oracle = Oracle(pair, self.steps)
        data = {name: pair.sample(self.batch, self.steps)[name] for name in model.observed}
        if pair.summed:
            self._sums_to_the_evidence(pair, oracle, data)
            return
        assert (oracle.bound(data) <= oracle.evidence(data) + 1e-9).all()
        gap = oracle.fit_guide()
        exact = audit(model.generative, model.inference, self.steps, model.observed).exact
        assert (gap < 1e-6) == exact, f"the audit returns exact={exact}, but the best guide's gap is {gap:.2g} nats"

    def test_the_evidence_lies_between_its_annealed_bounds(self) -> None:
        """On draws of the model, the mean bound is lower if annealing starts at the guide than at the true latents."""
        model, count = self._model(), 8
        if not model.latents or not model.likelihood or model.bounded:
            pytest.skip("no latents are drawn, the data are functions of them, or a bound replaces a density")
        context = {name: value for name, value in self._data(model, count).items() if name in model.context}
        values, _ = _run(model.model, context, length=self.steps, size=count)
        observations = {**context, **{name: values[name] for name in model.observed}}
        annealing: dict[str, Any] = {"temperatures": 2, "chains": 2, "leaps": 1}
        lower = annealed_bound(model, observations, **annealing).bound
        latents = {name: values[name] for name in model.latents}
        gap = annealed_bound(model, observations, latents=latents, **annealing).bound - lower
        assert gap.mean() > -4 * gap.std() / math.sqrt(count) - self.tolerance

    def test_training_stays_finite(self) -> None:
        """Weights after `fit` on `data`, in single precision, and forecasts from them are finite."""
        size = 4
        model, data = self.build(size), self.data(size)
        if not isinstance(data, Mapping):
            first, random_data = model.observed[0], self._data(model, *data.shape[:2])
            data = {**random_data, first: data} if model.generator[first].support is None else random_data
        fit(model, data, steps=self.training_steps, batch_size=8, accelerator="cpu", progress=False)
        assert all(torch.isfinite(parameter).all() for parameter in model.parameters())
        past = {
            name: v[:2, : v.shape[1] - 2] if name in model.observed and v.dim() == 3 else v[:2]
            for name, v in data.items()
            if name != "lengths"
        }
        assert all(torch.isfinite(value).all() for value in model.forecast(past, 2).values())

    # -------------------------------------------------------------------------------------------------- helpers

    def _sums_to_the_evidence(
        self, pair: DynamicalVAE, oracle: Oracle, data: dict[str, Tensor], draws: int = 500
    ) -> None:
        """For a model with states summed out, check that importance weights average to the evidence.

        The proposal is the exact posterior with a larger covariance.
        """
        mean, covariance = oracle.posterior(data)
        distribution = torch.distributions.MultivariateNormal(mean, 1.5 * covariance) if pair.latents else None
        samples = (
            torch.zeros(draws, self.batch, 0, dtype=torch.float64)
            if distribution is None
            else distribution.sample((draws,))
        )
        widths = [pair.sizes[name] * (self.steps if self._local(pair, name) else 1) for name in pair.latents]
        latents = {
            name: value.flatten(0, 1).unflatten(1, (self.steps, -1)) if self._local(pair, name) else value.flatten(0, 1)
            for name, value in zip(pair.latents, samples.split(widths, -1) if widths else (), strict=True)
        }
        joint = torch.stack(list(pair.log_joint(repeat(data, draws), latents).values())).sum(0)
        weights = joint.unflatten(0, (draws, -1)) - (0 if distribution is None else distribution.log_prob(samples))
        ratio = (weights - oracle.evidence(data)).exp()
        error = ratio.std(0) / math.sqrt(draws)
        assert ((ratio.mean(0) - 1).abs() <= 5 * error + 1e-9).all(), (
            f"the weights average to {ratio.mean(0)} of the evidence"
        )

    def _model(self, size: int = 2) -> DynamicalVAE:
        return self.build(size).double().eval()

    def _data(self, model: DynamicalVAE, batch: int = 0, steps: int = 0, names: Any = ()) -> dict[str, Tensor]:
        """Return random values of data and context, or of `names`; data of limited support are drawn by the model."""
        batch, steps = batch or self.batch, steps or self.steps
        values = {
            name: torch.randn(batch, *([steps] * self._local(model, name)), model.sizes[name], dtype=torch.float64)
            for name in names or (*model.observed, *model.context)
        }
        if bounded := [name for name in model.observed if name in values and model.generator[name].support is not None]:
            context = self._data(model, batch, steps, model.context) if model.context else {}
            samples = model.sample(batch, steps, context or None)
            values |= {name: samples[name] for name in bounded}
        return values

    def _mask(self, model: DynamicalVAE, name: str, values: Tensor) -> Tensor:
        """Return a random mask of the data, which shows or hides all coordinates of an event together."""
        mask = torch.rand_like(values) < 0.6
        for event in map(list, model.generator[name].events):
            mask[..., event] = mask[..., event[:1]]
        return mask

    def _local(self, model: DynamicalVAE, name: str) -> bool:
        generative = name in model.generative.variables or name in model.generative.context
        return (model.generative if generative else model.inference).local(name)

    def _reads(self, conditional: Conditional, values: Mapping[str, Tensor], name: str) -> Tensor:
        """Return a matrix (T or 1, S or 1), True where the parameters at step t depend on the parent at step s."""

        def parameters(value: Tensor) -> Tensor:
            out = torch.cat(conditional({**values, name: value}, 1, self.steps), dim=-1)
            combined = out @ torch.linspace(1.0, 2.0, out.shape[-1], dtype=out.dtype)  # one number per step suffices
            return combined.flatten()

        jacobian = torch.autograd.functional.jacobian(parameters, values[name])  # (T, 1, S, D) or (T, 1, D)
        return (jacobian != 0).any(-1).reshape(len(jacobian), -1)

    def _close(self, actual: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
        assert actual.keys() == expected.keys()
        for name, value in expected.items():
            difference = (actual[name] - value).abs().max().item()
            assert difference <= self.tolerance, f"{name} differs by {difference:.3g} nats between two ways of scoring"


@torch.no_grad()
def _run(program: Callable[..., Any], *args: Any, **kwargs: Any) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the values and log densities (B,) of a program's sites."""
    trace = poutine.trace(program).get_trace(*args, **kwargs)
    trace.compute_log_prob()
    sites: dict[str, Any] = {n: s for n, s in trace.nodes.items() if s["type"] == "sample" and n != "sequences"}
    return {n: s["value"] for n, s in sites.items()}, {n: s["log_prob"] for n, s in sites.items()}
