"""Control: motions bent to given paths, by the least move of their latents that does it, and of their poses.

Minimised over moves m of latents that start at z_k, in units of their prior's scale s, and over corrections e of the
poses that the decoder f makes of them

    |(x - path) / tolerance|^2 over known coordinates + |bone lengths / first - 1|^2 / stretch^2 + |m|^2 + |e / c|^2
    x = f(z_k + s m) + e

which is the mode of a posterior whose prior is centred at each draw, so that draws stay different. What a decoder has
not learned to make, no latent has it make; e is the few centimetres between, and shared out among joints by the bones.
TrajeVAE (Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351) names it as a limitation that given joints miss their
paths; bending is ours.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..motion import Skeleton
from .result import progress_bar

STRETCH = 0.02
"""Standard deviation of a bone's length, relative."""


def bend(
    decode: Callable[[Tensor], Tensor],
    latents: Tensor,
    scale: Tensor,
    paths: Tensor,
    known: Tensor,
    skeleton: Skeleton,
    bones: Tensor,
    *,
    tolerance: float = 5e-4,
    correction: float = 0.01,
    steps: int = 200,
    progress: bool = False,
) -> tuple[Tensor, Tensor]:
    """Motions that follow the paths, by L-BFGS.

    Args:
        decode: motions (S, T, D) in metres of latents (S, ...).
        latents: where to start from.
        scale: of the latents, positive; broadcasts against them.
        paths: (T, D), or (1, T, D).
        known: (T, D) 1 where the path is known, and else 0.
        skeleton: of the poses.
        bones: (J - 1,) lengths to keep, in metres.
        tolerance: metres, standard deviation of the misses.
        correction: c, metres, standard deviation of the corrections; 0 for none.
        steps: at most so many, of all motions together.
        progress: whether to show a progress bar.

    Returns:
        The motions (S, T, D), and their corrections (S, T, D) in metres.

    Raises:
        ValueError: a tolerance or a number of steps that is not positive, or a negative correction.
    """
    if not tolerance > 0 or steps < 1:
        raise ValueError(f"tolerance is a positive distance and steps at least 1, got {tolerance} and {steps}")
    if not correction >= 0:
        raise ValueError(f"correction is a distance or 0, got {correction}")
    with torch.no_grad():
        moves = [torch.zeros_like(latents), torch.zeros_like(decode(latents))]
    for each in moves[: 2 if correction else 1]:
        each.requires_grad_()
    free = [each for each in moves if each.requires_grad]

    def motion() -> Tensor:
        return decode(latents + scale * moves[0]) + correction * moves[1]

    optimiser = torch.optim.LBFGS(free, max_iter=steps, history_size=50, line_search_fn="strong_wolfe")
    with progress_bar(progress) as bar, torch.enable_grad():
        task = bar.add_task("following the paths", total=None)

        def loss() -> Tensor:
            x = motion()
            missed = ((x - paths) * known / tolerance).square().sum()
            stretched = ((skeleton.limbs(x).norm(dim=-1) / bones - 1) / STRETCH).square().sum()
            total = missed + stretched + sum(each.square().sum() for each in free)
            for each, gradient in zip(free, torch.autograd.grad(total, free), strict=True):
                each.grad = gradient
            bar.advance(task)
            return total.detach()

        optimiser.step(loss)  # type: ignore[no-untyped-call]
    with torch.no_grad():
        return motion(), correction * moves[1]
