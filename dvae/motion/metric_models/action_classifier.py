"""The action classifier: predicts the action of a motion, and provides features to compare sets of motions.

    p(c | x_{1:T})

A GRU reads the predicted part of a window. Its last state gives the *features*, and these the logits:

    features = tanh(W GRU(x_{O+1:T})_T + b)        p(c | x_{1:T}) = Categorical(logits = V features + a)

It is fitted to real training motion and then scores forecasts (`dvae.motion.scores(..., classifiers=...)`). ACC is the
fraction of futures assigned to the true class. FID is a distance between the features of real and of generated futures.

Bie, Guo, Leglaive, Girin, Moreno-Noguer and Alameda-Pineda, 2022, arXiv 2204.01565, only specify a "GRU of 2 layers,
128 units". The features follow public code of this family (BeLFusion). That code starts the GRU from normal noise at
every call, so its scores are random; here the initial state is zero and scores are deterministic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pyro
import torch
from pyro import distributions
from torch import Tensor, nn

from ...data.batch import Batch
from ...data.schema import SchemaError
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe, Trainable
from ...networks.cells import GRU
from ...options import Layers, Size
from ..data.protocols import Poses, Protocol, Windows
from ..geometry.skeleton import Skeleton

CLASS = "c"
IN_CACHE = 512
"""Number of sequences that the GRU reads at a time, so that its gates stay in a processor's cache."""


@dataclass(frozen=True)
class ActionClassifier(Trainable):
    """A classifier of actions, for the scores ACC and FID.

    Args:
        label: name of the clip label that gives the class; for Human3.6M also "action" or "group", the five groups of
            the paper, which need no labels in the file.
        hidden: number of units of the GRU.
        layers: number of layers of the GRU.
        features: number of features.
        classes: names of the classes in the order of the logits; default: all classes of the training clips, sorted.
    """

    name: ClassVar[str] = "action-classifier"
    source: ClassVar[str] = "Bie et al., 2022, arXiv 2204.01565"
    trainings: ClassVar[Mapping[str, Training]] = {"": Training(3000, 32, 3e-3, 0.5)}
    label: str = "content"
    hidden: Size = 128
    layers: Layers = 2
    features: Size = 30
    classes: tuple[str, ...] = ()

    def resolve_defaults(self, windows: Windows) -> ActionClassifier:
        """Return the method with its classes, by default those of all clips that are long enough for a window.

        Raises:
            ValueError: there are fewer than two classes.
        """
        if self.classes:
            return self
        if not isinstance(windows, Windows):
            raise SchemaError(
                "an action classifier reads the classes from the labels of clips, but the data have no clips; pass "
                "`dvae.motion.windows`"
            )
        classes = sorted({label for label in windows.clip_labels(self.label) if label is not None})
        if len(classes) < 2:
            raise ValueError(
                f"a classifier needs at least two classes: training clips have {' and '.join(classes) or 'nothing'} "
                f"for the label {self.label!r}; "
                f"labels are {', '.join(windows.label_names) or 'none (is labels.csv next to the file?)'}"
            )
        return replace(self, classes=tuple(classes))

    def build(self, data: Any) -> ActionClassifierModel:
        """Return the model for windows. A schema is not sufficient, because it does not contain the classes."""
        schema = Poses.of(data, "an action classifier")
        method = self if self.classes else self.resolve_defaults(data)
        return ActionClassifierModel(method, schema.skeleton, schema.sizes["x"], schema.protocol)

    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Return the recipe: minimise the negative log-likelihood of the windows' classes, in nats per window.

        Raises:
            ValueError: a clip has no such label, or its label is not one of the classes.
        """
        classes = self.resolve_defaults(train).classes
        held_out = validation and validation.classified(CLASS, self.label, classes)
        return Recipe(train.classified(CLASS, self.label, classes), held_out, [Stage(steps)])


class ActionClassifierModel(nn.Module):
    """The classifier network.

    Args:
        method: method with its classes.
        skeleton: skeleton of the windows.
        size: number of values per frame, D.
        protocol: protocol of the windows, whose predicted frames are classified.
    """

    likelihood, per = True, "window"  # required by `dvae.program.protocols.Program`

    def __init__(self, method: ActionClassifier, skeleton: Skeleton, size: int, protocol: Protocol):
        super().__init__()
        self.label, self.classes = method.label, method.classes
        self.skeleton, self.size, self.protocol = skeleton, size, protocol
        self.gru = GRU(size, method.hidden, method.layers, batch_first=True)
        self.project = nn.Linear(method.hidden, method.features)
        self.logits = nn.Linear(method.features, len(method.classes))

    def model(self, batch: Batch, **_: Any) -> dict[str, Tensor]:
        """Pyro program: one site c, batch (B,), observed at the classes of the windows.

        Args:
            batch: batch with x (B, T, D), and c (B,) int64, indices of the classes.

        Raises:
            ValueError: the batch has no classes, frames of another size, padded sequences or missing values.
        """
        if extra := {"lengths", "mask"} & batch.keys():
            raise ValueError(f"a classifier reads whole windows; remove {' and '.join(sorted(extra))} from the batch")
        if CLASS not in batch:
            raise ValueError(f"the batch has no {CLASS!r}, the class of each window; Windows.classified adds it")
        x = batch["x"]
        observed = self.protocol.observed
        if x.shape[1] <= observed:
            raise ValueError(f"windows of {x.shape[1]} frames have no future after the {observed} observed ones")
        logits = self.logits(self.features(x[:, observed:]))
        with pyro.plate("windows", len(x)):
            return {CLASS: pyro.sample(CLASS, distributions.Categorical(logits=logits), obs=batch[CLASS])}

    def guide(self, batch: Batch, **_: Any) -> dict[str, Tensor]:
        """Return no latents: the model has none."""
        return {}

    def forward(self, batch: Batch, **options: Any) -> dict[str, Tensor]:
        """Run `model`, as bounds do."""
        return self.model(batch, **options)

    def features(self, futures: Tensor) -> Tensor:
        """Return features (..., F) between -1 and 1 of predicted frames (..., H, D), the input of `logits`.

        Raises:
            ValueError: the frames have another size.
        """
        if futures.shape[-1] != self.size:
            raise ValueError(
                f"frames have {futures.shape[-1]} numbers, but this classifier was fitted to frames of {self.size}"
            )
        parts = futures.reshape(-1, *futures.shape[-2:]).split(IN_CACHE)
        last = torch.cat([self.gru(part)[0][:, -1] for part in parts])
        features_of_futures: Tensor = torch.tanh(self.project(last)).unflatten(0, futures.shape[:-2])
        return features_of_futures
