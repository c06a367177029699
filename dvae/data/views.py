"""Views: bijections between the data and their representation in a model.

A model has one view. `DynamicalVAE.read` applies it to a batch, and `DynamicalVAE.to_data_space` applies its inverse to
the model's data. In between, all values are in the representation of the model. Views for one kind of data are in the
package for these data.

Densities and bounds refer to the data as given: for a view that changes volume, the log-determinant is added to the log
density of the representation. All views here keep volume. A view that is not a bijection has two options. It raises an
error in `log_det`, and the model has no density. Or it sets `View.measured`, and densities refer to the representation.

>>> view = dvae.data.views.Parts({"legs": [0, 2], "arms": [1]})
>>> batch = dvae.data.Batch(x=torch.tensor([[[1.0, 2.0, 3.0]]]))
>>> {name: value.tolist() for name, value in view(batch).items()}
{'legs': [[[1.0, 3.0]]], 'arms': [[[2.0]]]}
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from ..constants import constant, indices
from ..factorization.notation import Factorization
from ..networks.loop import valid_steps
from .batch import WHOLE, Batch


class View:
    """The representation of the data in a model; this base class is the identity.

    A view may add values that its inverse needs, such as a heading, under a name of its own. Applying a view twice has
    no further effect.
    """

    names: tuple[str, ...] = ()
    """Names of other batch entries: those that the view reads, and those that it adds."""
    parts: Mapping[str, Sequence[int]] | None = None
    """Data variables that are coordinates of x and replace it."""
    history: str | None = None
    """Name of the context variable that contains the data themselves."""
    past: int = 0
    """Number of first frames of x that become context."""
    given: str | None = None
    """Name of the context variable that contains the given entries of x; the model draws the others."""
    exact: tuple[str, ...] = ()
    """Entries that the view adds in float64 whatever the precision of the model; x is then also read in float64."""
    by_coordinate: bool = False
    """Whether the view transforms only some coordinates of x, which must be continuous; others may be discrete."""
    measured: str = ""
    """Quantity that densities refer to, if it is not the data as given; bounds of different quantities differ."""

    @property
    def quantity(self) -> str:
        """Quantity that densities refer to; "" for the data as given.

        It consists of `measured` and, if the first steps are context (`past`), of the words "steps after the first".
        """
        return ", ".join(filter(None, [self.measured, later_steps(self.past)]))

    @property
    def by_step(self) -> bool:
        """Whether each step is transformed alone, so that sequences can grow step by step; a subclass declares it."""
        return type(self) is View

    def check(self, sizes: Mapping[str, int], context: Collection[str], generative: Factorization) -> None:
        """Check that a model is compatible with this view.

        Args:
            sizes: dimension of every variable of the model.
            context: names of the model's context.
            generative: generative factorization.

        Raises:
            ValueError: if the model is incompatible; the message states the reason.
        """

    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        """Return the data in the model's representation.

        Args:
            data: values (B, ...) by name.
            view_inputs: the batch of the past, already transformed, if `data` continue the sequences of this batch.

        Raises:
            ValueError: if the data cannot be transformed.
        """
        return data

    def inverse(self, model_values: Batch) -> Batch:
        """Map values from the model's representation back to the data.

        Args:
            model_values: values (..., B, T, D) by name in the model's representation, and the values (B, ...) that the
                view added.

        Returns:
            Values (..., B, T, D) by name in the data's representation.
        """
        return model_values

    def following(self, data: Batch) -> Batch:
        """Return the entries with which `inverse` maps the steps after the last one of a batch.

        Args:
            data: batch in the model's representation.
        """
        return data

    def log_det(self, data: Batch) -> Tensor:
        """Return the log absolute determinant of the Jacobian, (B,); 0 for a view that keeps volume.

        A view that transforms each entry of x separately returns a value for each entry, (B, T, D), and the sum omits
        missing entries and padding. Any other view that changes volume requires complete data.

        Args:
            data: batch in the data's representation.
        """
        some = next(iter(data.values()))
        zeros: Tensor = some.new_zeros(len(some))
        return zeros

    @property
    def keeps_volume(self) -> bool:
        """Whether the log-determinant is always 0."""
        return type(self).log_det is View.log_det

    def with_volume(self, data: Batch) -> tuple[Batch, Tensor | None]:
        """Return the data in the model's representation, and `counted`; None if the view keeps volume.

        Args:
            data: batch in the data's representation.
        """
        return Batch(self(data)), None if self.keeps_volume else self.counted(data)

    def counted(self, data: Batch) -> Tensor:
        """Return `log_det` without missing entries and padding.

        It is summed over coordinates, (B, T), if the view returns a value for each entry; otherwise it is (B,).

        Args:
            data: batch in the data's representation.

        Raises:
            ValueError: if the view returns one value per sequence, but some entries are missing or padding, or if the
                shape is invalid.
        """
        log_det = self.log_det(data)
        if log_det.dim() == 1 and not data.partial:
            return log_det
        if WHOLE not in data or log_det.shape != data[WHOLE].shape:
            raise ValueError(
                f"log_det of {self} has shape {tuple(log_det.shape)}, for data with "
                f"{' and '.join(n for n in ('lengths', 'mask') if n in data) or 'all entries'}; expected (B,) for "
                "complete sequences, or (B, T, D) with a value for each entry of x"
            )
        if (mask := data.mask()) is not None:
            log_det = torch.where(mask, log_det, 0.0)
        if data.lengths is not None:
            log_det = log_det.masked_fill(~valid_steps(data.lengths, log_det.shape[1])[..., None], 0)
        return log_det.sum(-1)


@dataclass(frozen=True)
class ContextView(View):
    """The identity, with context that a model may ignore.

    Args:
        names: names of context that batches may contain even if the model has no such variables.
    """

    names: tuple[str, ...] = ()
    by_step = True

    @override
    def inverse(self, model_values: Batch) -> Batch:
        return Batch({name: value for name, value in model_values.items() if name not in self.names})


@dataclass(frozen=True)
class Dequantised(View):
    """Uniform noise on rounded data, so that bounds of continuous distributions are bounded.

    A density has no bound at a value that occurs repeatedly, so bounds of rounded data can grow without limit. With
    noise u in [-r/2, r/2], the bound is at most log P(x) - log r, where P(x) is the probability that the model assigns
    to the rounded value x (Theis, van den Oord and Bethge, 2016, arXiv 1511.01844, section 3.1). Each reading of the
    data draws other noise. Values that return to the data, means included, are rounded to multiples of r.

    Args:
        widths: r of each coordinate of x; 0 for no noise.
    """

    widths: tuple[float, ...]
    names = (WHOLE, "rounding_noise")
    by_step = True
    measured = "values with uniform noise of the width of their rounding"

    @override
    def check(self, sizes: Mapping[str, int], context: Collection[str], generative: Factorization) -> None:
        if len(self.widths) != sizes.get(WHOLE):
            raise ValueError(f"rounding noise has {len(self.widths)} widths, but x has size {sizes.get(WHOLE)}")

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        if WHOLE not in data or "rounding_noise" in data:
            return data
        x = data[WHOLE]
        noise = (torch.rand_like(x) - 0.5) * constant(self.widths, x)
        return data | {WHOLE: x + noise, "rounding_noise": noise}

    @override
    def inverse(self, model_values: Batch) -> Batch:
        values = Batch({name: value for name, value in model_values.items() if name != "rounding_noise"})
        if WHOLE in values:
            x = values[WHOLE]
            widths = constant(self.widths, x)
            rounded = torch.where(widths > 0, (x / widths.clamp(min=1e-30)).round() * widths, x)
            values[WHOLE] = x + (rounded - x).detach()  # gradients of energies pass
        return values


class Views(View):
    """A sequence of views.

    Args:
        *views: views in the order from the data to the model.

    Raises:
        ValueError: if a `Past` follows a view that changes volume; the steps of a `Past` are not scored.
    """

    def __init__(self, *views: View):
        self.views = views
        self.names = tuple(name for view in views for name in view.names)
        self.parts = next((view.parts for view in views if view.parts), None)
        self.history = next((view.history for view in views if view.history), None)
        self.past = sum(view.past for view in views)
        self.given = next((view.given for view in views if view.given), None)
        self.exact = tuple(name for view in views for name in view.exact)
        self.by_coordinate = any(view.by_coordinate for view in views)
        self.measured = ", ".join(view.measured for view in views if view.measured)
        pasts = [index for index, view in enumerate(views) if isinstance(view, Past)]
        if not all(view.keeps_volume for view in views[: max(pasts, default=0)]):
            raise ValueError(f"{self} changes the volume of steps that are not scored; make Past the first view")

    @property
    @override
    def by_step(self) -> bool:
        return all(view.by_step for view in self.views)

    def __repr__(self) -> str:
        return f"Views({', '.join(map(repr, self.views))})"

    @override
    def check(self, sizes: Mapping[str, int], context: Collection[str], generative: Factorization) -> None:
        for view in self.views:
            view.check(sizes, context, generative)

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        for view in self.views:
            data = Batch(view(data, view_inputs))
        return data

    @override
    def inverse(self, model_values: Batch) -> Batch:
        for view in reversed(self.views):
            model_values = Batch(view.inverse(model_values))
        return model_values

    @override
    def following(self, data: Batch) -> Batch:
        for view in reversed(self.views):
            data = Batch(view.following(data))
        return data

    @override
    def log_det(self, data: Batch) -> Tensor:
        return super().log_det(data) if self.keeps_volume else Batch(log_det=self.counted(data)).volume

    @property
    @override
    def keeps_volume(self) -> bool:
        return all(view.keeps_volume for view in self.views)

    @override
    def with_volume(self, data: Batch) -> tuple[Batch, Tensor | None]:
        terms = []
        for view in self.views:
            data, term = view.with_volume(data)  # each view once, because a view may add noise
            terms += [] if term is None else [term]
        by_sequence = any(each.dim() == 1 for each in terms)
        terms = [Batch(log_det=each).volume if by_sequence else each for each in terms]
        return data, torch.stack(terms).sum(0) if terms else None

    @override
    def counted(self, data: Batch) -> Tensor:
        log_det = self.with_volume(data)[1]
        return super().counted(data) if log_det is None else log_det


@dataclass(frozen=True)
class Parts(View):
    """Data variables that are coordinates of one array x, which represents all of them in batches and forecasts.

    Args:
        parts: dictionary from variable name to its coordinates of x. Every coordinate belongs to exactly one variable.

    Example:
        >>> view = Parts({"legs": [0, 2], "arms": [1]})
        >>> view(Batch(x=torch.tensor([[[1.0, 2.0, 3.0]]])))["legs"]
        tensor([[[1., 3.]]])
    """

    parts: Mapping[str, Sequence[int]] = field()
    names = (WHOLE,)
    by_step = True

    @override
    def check(self, sizes: Mapping[str, int], context: Collection[str], generative: Factorization) -> None:
        coordinates = sorted(coordinate for part in self.parts.values() for coordinate in part)
        if coordinates != list(range(len(coordinates))):
            raise ValueError(f"the parts must contain each coordinate 0, 1, ... of x exactly once; got {coordinates}")
        for name, part in self.parts.items():
            if len(part) != sizes[name]:
                raise ValueError(f"the part {name} has {len(part)} coordinates, but sizes has {name}={sizes[name]}")
        if WHOLE in sizes:
            raise ValueError(f"with parts, {WHOLE!r} names the whole array; rename the variable {WHOLE!r}")

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        if WHOLE not in data:
            return data
        result, masks = Batch(data), data.masks()
        x, mask = result.pop(WHOLE), masks.pop(WHOLE, None)
        size = sum(map(len, self.parts.values()))
        if x.dim() < 2 or x.shape[-1] != size:
            raise ValueError(f"{WHOLE} has shape {tuple(x.shape)}, expected (B, T, {size})")
        for name, part in self.parts.items():
            columns = indices(part, x)
            result.setdefault(name, x.index_select(-1, columns))
            if mask is not None:
                masks[name] = mask.index_select(-1, columns)
        return result | {"mask": masks} if mask is not None else result

    @override
    def inverse(self, model_values: Batch) -> Batch:
        if not self.parts.keys() <= model_values.keys():
            return model_values
        order = [coordinate for part in self.parts.values() for coordinate in part]
        x = torch.cat([model_values[name] for name in self.parts], dim=-1)
        return model_values | {WHOLE: x.index_select(-1, indices(map(order.index, range(len(order))), x))}


@dataclass(frozen=True)
class History(View):
    """A copy of the data as a context variable.

    Factors must read it through a custom mask, such as h_{1:O}, that hides the frames to be generated.

    Args:
        history: name of the context variable.
        of: name of the data.
    """

    history: str = field()
    of: str = WHOLE

    @override
    def check(self, sizes: Mapping[str, int], context: Collection[str], generative: Factorization) -> None:
        name = self.history
        if name not in context:
            raise ValueError(
                f"the history {name!r} must be context of the model, which has {', '.join(context) or 'no context'}"
            )
        for factor in generative.factors:
            parent = factor.parent(name)
            if parent is not None and (parent.relation is None or parent.relation.intervals is not None):
                raise ValueError(
                    f"{factor} reads {parent}, but {name} is a copy of the data, and a forecast has only their past; "
                    f"give {name} a custom mask that hides the steps to predict, such as "
                    f'{name}_{{1:O}} with masks={{"1:O": lambda T: np.arange(T)[None] < 15}}'
                )

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        if self.of not in data or self.history in data or view_inputs is not None:
            return data
        masks = data.masks()
        result = data | {self.history: data[self.of]}
        return result | {"mask": {**masks, self.history: masks[self.of]}} if self.of in masks else result


@dataclass(frozen=True)
class Past(View):
    """The first frames of x as a static variable, which the other frames continue.

    A model with this view generates only the future. Bounds refer to the future given the past. A forecast observes
    only the past, so its latents come from the prior.

    Args:
        name: name of the past, (B, O D), frame after frame.
        frames: O, number of first frames.
        also: names of local context over the same frames as x; their first O frames are removed.

    Example:
        >>> {name: tuple(value.shape) for name, value in Past("s")(Batch(x=torch.zeros(2, 5, 3))).items()}
        {'x': (2, 4, 3), 's': (2, 3)}
    """

    name: str
    frames: int = 1
    also: tuple[str, ...] = ()

    @property
    def past(self) -> int:  # type: ignore[override]
        """Number of first frames that become context."""
        return self.frames

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        if WHOLE not in data or self.name in data or view_inputs is not None:
            return data
        if data.lengths is not None:
            raise ValueError("a view with `Past` requires windows of one length; remove 'lengths' from the batch")
        x, masks, frames = data[WHOLE], data.masks(), self.frames
        if x.shape[1] < frames:
            raise ValueError(
                f"this model requires at least {frames} observed steps, got {x.shape[1]}; give longer sequences"
            )
        for name in self.also:
            if name in data and data[name].shape[1] != x.shape[1] > frames:
                raise ValueError(
                    f"x {tuple(x.shape)} has {self.name} as its first steps, so {name} must cover the "
                    f"whole window, (B, {frames} + T, D); got {tuple(data[name].shape)}"
                )
        later = {name: data[name][:, frames:] for name in (WHOLE, *self.also) if name in data}
        result = data | {**later, self.name: x[:, :frames].flatten(1)}
        if WHOLE in masks:
            result["mask"] = {**masks, WHOLE: masks[WHOLE][:, frames:], self.name: masks[WHOLE][:, :frames].flatten(1)}
        if x.shape[1] == frames:
            del result[WHOLE]
            result.get("mask", {}).pop(WHOLE, None)
        return result

    @override
    def inverse(self, model_values: Batch) -> Batch:
        if self.name not in model_values:
            return model_values
        first = model_values[self.name].unflatten(-1, (self.frames, -1))
        return model_values | {WHOLE: torch.cat([first, model_values[WHOLE]], -2) if WHOLE in model_values else first}


GIVEN = "given"
"""Name of the batch entry (B, T, D) that is True or 1 where an entry of x is given."""


def later_steps(observed: int) -> str:
    """Return words for the steps after the given ones; "" if none is given."""
    return f"steps after the first {observed} given the first {observed}" if observed else ""


def given_entries(data: Batch, observed: int | None) -> Tensor:
    """Return True at the given entries (B, T, D) of x, which are observed and neither missing nor padding.

    Args:
        data: batch in the data's representation.
        observed: number of first steps that are given if the batch has no entry "given"; None for no step.
    """
    x, mask, given = data[WHOLE], data.mask(), data.get(GIVEN)
    if given is None:
        given = (torch.arange(x.shape[1], device=x.device) < (observed or 0))[:, None].expand_as(x)
    given = given > 0 if mask is None else (given > 0) & mask
    return given if data.lengths is None else given & valid_steps(data.lengths, x.shape[1])[..., None]


@dataclass(frozen=True)
class Given(View):
    """Given entries of x as local context, for a distribution of the other entries, the targets.

    The context consists of the given values and their indicators, (B, T, 2 D). A model with this view, such as
    p(x_{1:T} | g_{1:T}), imputes missing entries given all observed ones, and forecasts given all observed steps. The
    entry "given" (B, T, D) of a batch is 1 where an entry is given; bounds refer to the other observed entries.

    Args:
        given: name of the context.
        observed: number of first steps that are given in batches without the entry "given"; None for no step.

    Example:
        >>> batch = Batch(x=torch.tensor([[[1.0], [2.0]]]), given=torch.tensor([[[True], [False]]]))
        >>> data = Given("g")(batch)
        >>> data["mask"]["x"].flatten().tolist(), torch.where(data["mask"]["g"], data["g"], 0.0).tolist()
        ([False, True], [[[1.0, 1.0], [0.0, 0.0]]])
    """

    given: str = field()
    observed: int | None = None
    names = (GIVEN,)

    @property
    def measured(self) -> str:  # type: ignore[override]
        """Quantity that densities refer to: all entries if none is given."""
        return later_steps(self.observed or 0)

    @override
    def check(self, sizes: Mapping[str, int], context: Collection[str], generative: Factorization) -> None:
        if self.given not in context or sizes[self.given] != 2 * sizes[WHOLE]:
            raise ValueError(
                f"{self.given!r} has values and indicators of x, so it must be context of size 2 x {sizes[WHOLE]}; "
                f"the context is {', '.join(f'{name} ({sizes[name]})' for name in context) or 'nothing'}"
            )

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        if WHOLE not in data or self.given in data:
            return data
        x, masks, given = data[WHOLE], data.masks(), given_entries(data, self.observed)
        context = torch.cat([x, given.to(x)], -1)
        masks[self.given] = torch.cat([given, torch.ones_like(given)], -1)
        masks[WHOLE] = masks[WHOLE] & ~given if WHOLE in masks else ~given
        return Batch({n: v for n, v in data.items() if n != GIVEN}) | {self.given: context, "mask": masks}
