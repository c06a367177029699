"""GradNorm: adaptive weights that balance the training rates of losses (Chen et al. 2018, arXiv 1711.02257).

For n tasks with losses L_i, weights w_i and shared parameters W:

    G_i = |grad_W w_i L_i|                                norms of gradients; Gbar is their mean
    r_i = (L_i / L_i(0)) / mean_j (L_j / L_j(0))          relative inverse training rates
    L_grad = sum_i |G_i - Gbar r_i^a|                     with the targets Gbar r_i^a held constant

The weights descend L_grad and are then scaled to the sum n. G_i is proportional to w_i, so its derivative with respect
to log w_i is G_i itself, and no second backward pass is needed. We descend L_grad / Gbar in log w instead of L_grad in
w:

    log w_i <- log w_i - rate sign(G_i - Gbar r_i^a) G_i / Gbar

Weights are then positive without clipping, and the rate does not depend on the units of the losses. The published
update, w_i <- w_i - rate sign(G_i - Gbar r_i^a) G_i / w_i, is an option.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from torch import Tensor, nn

from ...options import Range, Share, check
from .objectives import Evidence

if TYPE_CHECKING:
    from ..bounds.elbo import Terms


@dataclass(frozen=True)
class GradNorm:
    """Objective with adaptive weights for named log-likelihoods and energies; `others` weighs all other terms.

    Let L_i be a negative log-likelihood, or an energy, summed over the batch and divided by its number of steps. Then

        loss = sum_tasks w_i L_i + others(the other terms).

    The weights are reset to 1 at each stage and are part of the checkpoint; `log.jsonl` records them as "weight/NAME".
    Called directly, for example by a validation with "loss", the objective uses weights of 1, so that losses can be
    compared. With several processes, gradients are averaged over them, as for the model.

    Args:
        tasks: names of log-likelihoods and energies, at least two.
        shared: prefix of the names of the parameters W, such as a last layer that all tasks use.
        others: objective that weighs all other terms, including the KL, and defines `draws` and `select`.
        asymmetry: a, how strongly the weights favour slowly training tasks. At 0, norms of gradients are equalised.
            Above 0, losses must be positive; negative log densities need `lowest`. The paper uses 0.12, and 1.5 if
            tasks differ more.
        learning_rate: learning rate of log w, the change per step for a task whose gradient has the mean norm; or of w.
        update: "relative" descends in log w, "published" in w. The second depends on the units of the losses.
        lowest: constants by task that are subtracted from L_i, so that training rates compare losses above their
            minimum. For a normal with fixed deviation s of D numbers, D log(s sqrt(2 pi)) leaves the squared error.

    Raises:
        ValueError: with fewer than two tasks, or a repeated one; on the first call, if a task is not such a term or
            does not depend on the shared parameters; before training, if the model has no such parameters; in
            training, if the published update makes a weight negative.

    Example:
        >>> weighing = dvae.GradNorm(("pose", "time"), shared="generator.x.", others=dvae.Evidence(kl_weight=0.01))
        >>> terms = dvae.Terms({}, {"z": torch.ones(1)}, {"pose": torch.ones(1), "time": torch.ones(1)}, torch.ones(1))
        >>> weighing(terms, step=0)
        tensor(2.0100)
    """

    tasks: tuple[str, ...]
    shared: str
    others: Evidence = field(default_factory=Evidence)
    asymmetry: Annotated[float, Range(0, 10)] = 0.12
    learning_rate: Share = 0.025
    update: Literal["relative", "published"] = "relative"
    lowest: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check(self)
        if unknown := self.lowest.keys() - {*self.tasks}:
            raise ValueError(f"`lowest` includes {min(unknown)!r}, but the tasks are {', '.join(self.tasks)}")
        if len(set(self.tasks)) != len(self.tasks) or len(self.tasks) < 2:
            raise ValueError(f"tasks must be two or more different names, got {', '.join(self.tasks) or 'none'}")

    @property
    def draws(self) -> Mapping[str, int]:
        """Draws that `others` needs."""
        return self.others.draws

    @property
    def select(self) -> Literal["bound", "loss"]:
        """Score that selects the best weights, as in `others`."""
        return self.others.select

    def __call__(self, terms: "Terms", step: int) -> Tensor:
        """Return the loss with all weights of tasks 1, a scalar."""
        return self.loss(terms, self.weights(step))

    def weights(self, step: int) -> dict[str, float]:
        """Return the weights of `others` at a global step, and 1 for each task, as "task/NAME"."""
        return self.others.weights(step) | {f"task/{task}": 1.0 for task in self.tasks}

    def loss(self, terms: "Terms", weights: Mapping[str, Any]) -> Tensor:
        """Return the loss, a scalar.

        Args:
            terms: terms of the bound.
            weights: weights as in `weights`, as numbers or scalar tensors.

        Raises:
            ValueError: the model has no log-likelihood or energy with the name of a task.
        """
        other_terms = [
            {name: value for name, value in table.items() if name not in self.tasks}
            for table in (terms.log_likelihood, terms.energies)
        ]
        loss = self.others.loss(replace(terms, log_likelihood=other_terms[0], energies=other_terms[1]), weights)
        for task, value in zip(self.tasks, self.losses(terms), strict=True):
            loss = loss + weights[f"task/{task}"] * value
        return loss

    def losses(self, terms: "Terms") -> list[Tensor]:
        """Return the losses of the tasks in their order, scalars, each divided by the number of steps.

        Args:
            terms: terms of the bound.

        Raises:
            ValueError: the model has no log-likelihood or energy with the name of a task.
        """
        costs = {name: -value for name, value in terms.log_likelihood.items()} | terms.energies
        if unknown := [task for task in self.tasks if task not in costs]:
            raise ValueError(
                f"`tasks` includes {', '.join(map(repr, unknown))}, but the log-likelihoods and energies are "
                f"{', '.join(costs) or 'none'}; set the weights of all other terms in others"
            )
        return [costs[task].sum() / terms.n_steps.sum() - self.lowest.get(task, 0.0) for task in self.tasks]

    def begin(self, model: nn.Module) -> "Balance":
        """Return the objective for a stage of a run, with its own weights, which start at 1.

        Args:
            model: model to train.

        Raises:
            ValueError: no trained parameter has a name that starts with `shared`.
        """
        trained = {name: value for name, value in model.named_parameters() if value.requires_grad}
        shared = [value for name, value in trained.items() if name.startswith(self.shared)]
        if not shared:
            raise ValueError(
                f"`shared` is {self.shared!r}, but no parameter's name starts with it; "
                f"the parameters are {', '.join(trained)}"
            )
        return Balance(self, shared)

    def to_config(self) -> dict[str, Any]:
        """Return the objective as a JSON object."""
        config = vars(self) | {"tasks": list(self.tasks), "lowest": dict(self.lowest)}
        config["others"] = self.others.to_config()
        return {"objective": "GradNorm"} | config


class Balance:
    """Weights of a `GradNorm` in a stage of a run, as an `objectives.StatefulObjective`.

    Args:
        objective: objective that the weights belong to.
        shared: shared parameters W.
    """

    def __init__(self, objective: GradNorm, shared: list[nn.Parameter]) -> None:
        self.objective = objective
        self.shared = shared
        self.task_weights = torch.ones(len(objective.tasks), dtype=torch.float64)
        self.first = torch.zeros_like(self.task_weights)  # L_i(0), zeros before the first step

    def __call__(self, terms: "Terms", step: int) -> Tensor:
        """Return the loss, a scalar."""
        return self.loss(terms, self.weights(step))

    def weights(self, step: int) -> dict[str, float]:
        """Return the weights of `GradNorm.weights` at a global step, with the present weights of the tasks."""
        present = zip(self.objective.tasks, self.task_weights.tolist(), strict=True)
        return self.objective.weights(step) | {f"task/{task}": weight for task, weight in present}

    def loss(self, terms: "Terms", weights: Mapping[str, Any]) -> Tensor:
        """Return the loss at given weights, as `GradNorm.loss` does."""
        return self.objective.loss(terms, weights)

    def measure(self, terms: "Terms") -> dict[str, Tensor]:
        """Return the losses (tasks,) of a batch, and their gradients (tasks, W) with respect to W."""
        losses = self.objective.losses(terms)
        gradients = [self._gradient(*each) for each in zip(self.objective.tasks, losses, strict=True)]
        return {"losses": torch.stack([loss.detach() for loss in losses]), "gradients": torch.stack(gradients)}

    def adapt(self, measured: Mapping[str, Tensor], mean: Callable[[Tensor], Tensor]) -> None:
        """Update the weights, for the loss of the next step.

        Args:
            measured: result of `measure`.
            mean: function that averages a tensor over the processes.

        Raises:
            ValueError: when the training rate of a loss is not defined, because the loss is not positive; or when the
                published update makes a weight negative.
        """
        norms = torch.linalg.vector_norm(mean(measured["gradients"]), dim=1, dtype=torch.float64)
        losses, norms = torch.stack([mean(measured["losses"]).double(), norms]).cpu()  # one synchronisation
        first, asymmetry = self.first if self.first.any() else losses, self.objective.asymmetry
        for task, start, now in zip(self.objective.tasks, first.tolist(), losses.tolist(), strict=True):
            if asymmetry and (start <= 0 or now < 0):
                raise ValueError(
                    f"the loss of {task} is {now:.4g}, and was {start:.4g} at first, but training rates need positive "
                    "losses; give their minimum as `lowest`, or set asymmetry=0, which does not use training rates"
                )
        self.first = first
        smallest = torch.finfo(torch.float64).tiny  # if all losses or all gradients are 0
        ratios = losses / first if asymmetry else torch.ones_like(losses)
        weighted = self.task_weights * norms
        target = weighted.mean() * (ratios / ratios.mean().clamp(min=smallest)) ** asymmetry
        direction, rate = torch.sign(weighted - target), self.objective.learning_rate
        if self.objective.update == "relative":
            move = direction * weighted / weighted.mean().clamp(min=smallest)
            self.task_weights = torch.softmax(self.task_weights.log() - rate * move, 0) * len(move)
            return
        weights = self.task_weights - rate * direction * norms
        if not (weights > 0).all():
            row = dict(zip(self.objective.tasks, weights.tolist(), strict=True))
            raise ValueError(
                f"the published update makes the weight of {min(row, key=row.__getitem__)} {min(row.values()):.3g}; "
                "give a lower learning_rate, or update='relative', whose weights are positive"
            )
        self.task_weights = weights * len(weights) / weights.sum()

    @property
    def row(self) -> dict[str, float]:
        """Weights by name, for the log."""
        present = zip(self.objective.tasks, self.task_weights.tolist(), strict=True)
        return {f"weight/{task}": weight for task, weight in present}

    @property
    def state(self) -> dict[str, Tensor]:
        """Weights, and the losses of the first step."""
        values = {"weight": self.task_weights, "first": self.first}
        return {
            f"{name}/{task}": value[i] for name, value in values.items() for i, task in enumerate(self.objective.tasks)
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Continue with the state of a checkpoint.

        Raises:
            ValueError: when a weight is not positive, or the weights do not add up to the number of tasks.
        """
        tasks = self.objective.tasks
        weights, first = (torch.stack([state[f"{name}/{task}"] for task in tasks]) for name in ("weight", "first"))
        if not (weights > 0).all() or abs(weights.sum() - len(tasks)) > 1e-6:
            raise ValueError(f"the weights of {', '.join(tasks)} must be positive numbers with the sum {len(tasks)}")
        self.task_weights, self.first = weights, first

    def _gradient(self, task: str, loss: Tensor) -> Tensor:
        """Return the flat gradient of a task's loss with respect to W; zeros if the loss of this batch is constant."""
        zeros = [torch.zeros_like(value) for value in self.shared]
        gradients_or_none = (
            torch.autograd.grad(loss, self.shared, retain_graph=True, allow_unused=True)
            if loss.requires_grad
            else zeros
        )
        if all(gradient is None for gradient in gradients_or_none):
            raise ValueError(
                f"the loss of {task} does not depend on the parameters whose names start with "
                f"{self.objective.shared!r} (shared); choose parameters that all tasks use"
            )
        gradients = [
            zero if gradient is None else gradient for gradient, zero in zip(gradients_or_none, zeros, strict=True)
        ]
        return torch.cat([gradient.flatten() for gradient in gradients])
