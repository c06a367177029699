"""Numbers of every method that a change of the code must not change.

    python -m tests.record write            compute and store them
    python -m tests.record check [NAME…]    compute them again and list every difference

Each method is built with sets of options that contain every pair of values of two options (a pairwise cover, as far as
options can be chosen freely). For each set the file stores, in double precision: the number of parameters, the terms of
a bound from one seed, the norm of its gradient, the losses of three training steps, a forecast and an imputation. The
first set also has the scores of an evaluation and a comparison. Refused options are stored too. Numbers are equal
to rounding if they differ by less than `TOLERANCE` of their size. Run the check on the kind of processor that wrote the
file: single precision draws differ between instruction sets, and some methods amplify them. On another one, write the
record from the commit before the change first.
"""

import argparse
import gzip
import itertools
import json
import math
import sys
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields, replace
from functools import partial
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import torch

import dvae

PATH = Path(__file__).with_name("record.json.gz")
TOLERANCE = 1e-6
SKIPPED = {
    "units",
    "cvae_run",
    "pose_prior_run",
    "presets",
    "grouped",
}  # need a fitted run or a table, or have one value here
EQUATIONS = (
    {},
    {
        "generative": "p(w) p(z_t | z_{t-1}, w) p(x_t | x_{t-2:t-1}, z_t)",
        "inference": "q(w | x_{1:T}) q(z_t | z_{>t}, x_{1:T}, w)",
    },
    {"generative": "p(w) p(x_t | x_{t-1}, w)", "inference": "q(w | x_{1:T})"},
    {
        "generative": "p(s_t | s_{t-1}) p(z_t | z_{t-1}, s_t) p(x_t | z_t)",
        "inference": "q(z_t | z_{t-1}, x_{t:T})",
        "states": {"s": 3},
    },
)
VALUES: dict[str, tuple[Any, ...]] = {  # small ones, and those that types do not give
    "latent": (4, 3),
    "static": (3, 0),
    "heads_count": (2, 1),
    "warm_up": (2, 0),
    "prior_components": (2, 3),
    "prior_steps": (4, 6),
    "hidden": ((6,), (5, 4)),
    "encoder": (None, (6,)),
    "decoder": ((6,), (5, 4)),
    "embed_latent": (3, 2),
    "embed": (3, 2),
    "transition": ((), (4,)),
    "frames": (None, 6),
    "parts": (("lower", "upper"), ()),
    "draws": (None, (3, 2)),
    "diversity": (None,),
    "diversity_scale": (None,),
    "fixed": ((),),
    "network": ("recurrent", "attention"),
    "sampler_hidden": ((6,), (5, 4)),
    "widths": ((6,), (5, 4)),
    "maps": (None, (4, 3, 2)),
    "layers": (1, 2),
    "blocks": (1, 2),
    "flow_steps": (2, 1),
    "modes": (3, 2),
    "pseudo_most": (3,),
    "pool_stride": (20,),
    "data_frames": (5,),
    "output_frames": (5,),
    "latents": ({},),
    "states": (3, 2),
}


def levels(name: str, hint: Any, default: Any) -> tuple[Any, ...]:
    """Values of an option to try."""
    origin, arguments = get_origin(hint), get_args(hint)
    if name in VALUES:
        values = VALUES[name]
        if isinstance(values[-1], tuple) != ("tuple" in str(hint)):
            values = tuple((each,) if isinstance(each, int) else each and each[-1] for each in values)
        return values
    if origin is Annotated:
        return levels(name, arguments[0], default)
    if origin in (Union, UnionType):
        inner = [each for each in arguments if each is not NoneType]
        return tuple(dict.fromkeys((None, *levels(name, inner[0], None))))
    if origin is Literal:
        return arguments
    if hint is bool:
        return (False, True)
    if hint is int:
        return (8, 4) if default is None or default > 8 else (default,)
    if hint is float:
        return tuple(dict.fromkeys((default, 0.3))) if default is not None else (0.3,)
    return (default,)


def cover(options: Mapping[str, tuple[Any, ...]], most: int = 24) -> list[dict[str, Any]]:
    """Return rows that cover every pair of values, chosen greedily; the first row has the first values."""
    names = list(options)
    missing = {
        (a, i, b, j)
        for a, b in itertools.combinations(range(len(names)), 2)
        for i in range(len(options[names[a]]))
        for j in range(len(options[names[b]]))
    }

    def pairs(row: list[int]) -> set[tuple[int, int, int, int]]:
        return {(a, row[a], b, row[b]) for a, b in itertools.combinations(range(len(row)), 2)}

    rows = [[0] * len(names)]
    missing -= pairs(rows[0])
    while missing and len(rows) < most:
        a, i, b, j = min(missing)
        row = [-1] * len(names)
        row[a], row[b] = i, j
        for place, name in enumerate(names):
            if row[place] < 0:
                gains = []
                for level in range(len(options[name])):
                    others = ((other, row[other]) for other in range(len(names)) if row[other] >= 0)
                    keys = ((o, k, place, level) if o < place else (place, level, o, k) for o, k in others)
                    gains.append(sum(key in missing for key in keys))
                row[place] = gains.index(max(gains))
        missing -= pairs(row)
        rows.append(row)
    return [{name: options[name][level] for name, level in zip(names, row, strict=True)} for row in rows]


def options_of(name: str, data: Any) -> list[dict[str, Any]]:
    """Return sets of options of a method, without values refused with the first values of the other options."""
    kind = dvae.methods()[name]
    hints = get_type_hints(kind, include_extras=True)
    known = {
        field.name: levels(
            field.name,
            hints[field.name],
            None if field.default is MISSING else field.default,
        )
        for field in fields(kind)
        if field.name not in SKIPPED and not (get_origin(hints[field.name]) is None and hints[field.name] is NoneType)
    }
    first = {key: values[0] for key, values in known.items()}

    def possible(key: str, value: Any) -> bool:
        try:
            method = dvae.method(name, **{**first, key: value}).resolve_defaults(data.windows("train"))
            method.build(data.schema)
            method.train(data.windows("train"), None, 3)
        except (ValueError, TypeError):
            return False
        return True

    if name != "equations":
        alone = {k: tuple(v for n, v in enumerate(vs) if not n or possible(k, v)) for k, vs in known.items()}
        return cover(alone)
    free = {key: value for key, value in known.items() if key not in ("generative", "inference", "states", "latents")}
    return [row | pair for pair in EQUATIONS for row in cover(free, 8)]


def data_of(name: str, cache: dict[str, Any]) -> Any:
    """Simulated motion, as the method reads it."""
    from dvae.models.motion.trajectories import TrajectoryMethod
    from dvae.motion.segments.dataset import SegmentData

    method = dvae.methods()[name]
    representation = getattr(method, "representation", "positions")
    kind = "segments" if name == "motion-latent" else representation
    if issubclass(method, TrajectoryMethod):
        kind = "trajectories"
    if kind not in cache:
        clips = dvae.motion.simulate(clips=10, frames=90, seed=1)
        if kind == "segments":
            cache[kind] = SegmentData("simulated", clips)
        else:
            protocol = dvae.motion.PROTOCOLS["simulated-trajectories" if kind == "trajectories" else "simulated"]
            protocol = replace(protocol, representation=representation)
            if representation != "positions":
                clips = clips.with_rotations()
            cache[kind] = dvae.motion.MotionData("simulated", clips, protocol)
    return cache[kind]


def double(value: Any) -> Any:
    """Floating-point tensors of a batch in double precision."""
    if isinstance(value, Mapping):
        return {key: double(each) for key, each in value.items()}
    return value.double() if isinstance(value, torch.Tensor) and value.is_floating_point() else value


class Doubled:
    """A source whose batches are in double precision."""

    def __init__(self, source: Any) -> None:
        self.source = source

    def sample(self, batch_size: int, generator: torch.Generator) -> Any:
        """Return a batch."""
        return double(self.source.sample(batch_size, generator))


def some(values: torch.Tensor) -> list[float]:
    """A few numbers that depend on all entries."""
    flat = values.detach().double().flatten().nan_to_num(7.0)
    weights = torch.cos(torch.arange(len(flat), dtype=torch.float64))
    return [float(flat.mean()), float((flat * weights).mean()), float(flat[-1])]


def numbers(name: str, options: Mapping[str, Any], data: Any, whole: bool) -> dict[str, Any]:
    """Return the recorded numbers of one set of options."""
    found: dict[str, Any] = {}
    train, test = data.windows("train"), data.windows("test")
    method = dvae.method(name, **options).resolve_defaults(train)
    torch.manual_seed(0)
    model = method.build(data.schema).double()
    found["parameters"] = sum(parameter.numel() for parameter in model.parameters())
    recipe = method.train(train, None, 3)
    torch.manual_seed(1)
    recipe.prepare(model)
    source = recipe.batches
    batch = double(source.sample(4, torch.Generator().manual_seed(2)))
    objective = recipe.objective
    draws = getattr(objective, "draws", {})
    torch.manual_seed(3)
    terms = dvae.SequenceELBO().terms(model, batch, **({"draws": draws} if draws else {}))
    for group in ("log_likelihood", "kl", "energies"):
        for key, value in getattr(terms, group).items():
            found[f"{group} {key}"] = float(value.sum())
    total = sum(value.sum() for group in (terms.log_likelihood, terms.kl, terms.energies) for value in group.values())
    learned = [parameter for parameter in model.parameters() if parameter.requires_grad]
    grads = torch.autograd.grad(total, learned, allow_unused=True)
    found["gradient"] = math.sqrt(sum(float((grad**2).sum()) for grad in grads if grad is not None))
    model.eval()
    future = double(test.sample(2, torch.Generator().manual_seed(4)))
    observed = data.schema.observed
    if observed is not None and name != "motion-latent":
        torch.manual_seed(5)
        past = {**future, "x": future["x"][:, :observed]}
        found["forecast"] = some(model.forecast(past, future["x"].shape[1] - observed, 3)["x"])
    mask = torch.ones_like(future["x"], dtype=torch.bool)
    mask[:, 20:30, ::2] = False
    torch.manual_seed(6)
    try:
        found["imputation"] = some(model.impute({**future, "mask": mask}, 2)["x"])
    except (ValueError, TypeError, NotImplementedError):
        found["imputation"] = "refused"
    torch.manual_seed(7)
    recipe = replace(recipe, batches=Doubled(source), prepare=lambda model: None)  # it is prepared already
    fit = dvae.fit(model, recipe, batch_size=4, log_every=1, seed=1, accelerator="cpu", progress=False)
    found["losses"] = [row["loss"] for row in fit.history]
    if whole and observed is not None and name != "motion-latent":
        few = {"samples": 4, "batch_size": 8, "progress": False}
        evaluation = dvae.evaluate(model.float(), test, scores=dvae.motion.scores, training_windows=train, **few)
        for row in evaluation.rows:
            for metric, score in evaluation[row].items():
                found[f"evaluation {row} {metric}"] = float(score.mean)
        if terms.log_likelihood and not terms.energies:
            comparison = dvae.compare({"a": model}, test, particles=8, contrasts=8, samples=0, progress=False)
            for metric, estimate in comparison["a"].items():
                found[f"comparison {metric}"] = float(estimate.mean)
    return found


def record(names: list[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every case with its numbers."""
    from dvae.models.motion import energies

    energies.fit_pose_prior = partial(energies.fit_pose_prior, steps=2, progress=False)  # a thousand take a minute
    cache: dict[str, Any] = {}
    for name in names:
        data = data_of(name, cache)
        for place, options in enumerate(options_of(name, data)):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    found = numbers(name, options, data, whole=place == 0)
            except (ValueError, TypeError) as error:
                found = {"refused": type(error).__name__}
                print(f"{name}: {error}"[:300], file=sys.stderr)
            yield f"{name} {json.dumps(options)}", found


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each number that differs by more than rounding."""
    for key in dict.fromkeys((*old, *new)):
        before, after = old.get(key), new.get(key)
        pair = [each if isinstance(each, list) else [each] for each in (before, after)]
        if len(pair[0]) == len(pair[1]) and all(map(alike, *pair, [key] * len(pair[0]))):
            continue
        yield f"{key}: {before} -> {after}"


def alike(first: Any, second: Any, key: str) -> bool:
    """Whether two numbers are equal to rounding; scores are computed in single precision."""
    if not isinstance(first, int | float) or not isinstance(second, int | float):
        return bool(first == second)
    tolerance = 1e-3 if key.startswith(("evaluation", "comparison")) else TOLERANCE
    return math.isclose(first, second, rel_tol=tolerance, abs_tol=tolerance) or (first != first and second != second)


def main() -> int:
    """Write or check the record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["write", "check"])
    parser.add_argument("names", nargs="*", help="methods; all where none is given")
    arguments = parser.parse_args()
    names = arguments.names or list(dvae.methods())
    stored = json.loads(gzip.decompress(PATH.read_bytes())) if PATH.exists() else {}
    failed, count = 0, 0
    for case, found in record(names):
        count += 1
        if arguments.command == "write":
            stored[case] = found
            continue
        for line in differences(stored.get(case, {}), found):
            failed += 1
            print(f"{case}\n    {line}")
    if arguments.command == "write":
        PATH.write_bytes(gzip.compress(json.dumps(stored, indent=0).encode(), mtime=0))
        refused = sum("refused" in found for found in stored.values())
        print(f"{len(stored)} cases, of which {refused} are refused")
    else:
        print(f"{count} cases, {failed} numbers differ")
    return bool(failed)


if __name__ == "__main__":
    raise SystemExit(main())
