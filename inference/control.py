"""Control: motions bent to given paths, by the least move of their latents that does it.

Minimised over moves m of latents that start at z_k, in units of their prior's scale s,

    |(f(z_k + s m) - path) / tolerance|^2 over known coordinates + |bone lengths / first - 1|^2 / stretch^2 + |m|^2

with f the decoder: the mode of a posterior whose prior is centred at each draw, so that draws stay different. TrajeVAE
(Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351) names it as a limitation that given joints miss their paths;
bending is ours.
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
    steps: int = 200,
    progress: bool = False,
) -> Tensor:
    """Latents near given ones whose motions follow the paths, by L-BFGS.

    Args:
        decode: motions (S, T, D) in metres of latents (S, ...).
        latents: where to start from.
        scale: of the latents, positive; broadcasts against them.
        paths: (T, D), or (1, T, D).
        known: (T, D) 1 where the path is known, and else 0.
        skeleton: of the poses.
        bones: (J - 1,) lengths to keep, in metres.
        tolerance: metres, standard deviation of the misses.
        steps: at most so many, of all motions together.
        progress: whether to show a progress bar.

    Returns:
        Latents, of the shape of those given.

    Raises:
        ValueError: a tolerance or a number of steps that is not positive.
    """
    if not tolerance > 0 or steps < 1:
        raise ValueError(f"tolerance is a positive distance and steps at least 1, got {tolerance} and {steps}")
    move = torch.zeros_like(latents, requires_grad=True)
    optimiser = torch.optim.LBFGS([move], max_iter=steps, history_size=50, line_search_fn="strong_wolfe")
    with progress_bar(progress) as bar, torch.enable_grad():
        task = bar.add_task("following the paths", total=None)

        def loss() -> Tensor:
            x = decode(latents + scale * move)
            missed = ((x - paths) * known / tolerance).square().sum()
            stretched = ((skeleton.limbs(x).norm(dim=-1) / bones - 1) / STRETCH).square().sum()
            total = missed + stretched + move.square().sum()
            (move.grad,) = torch.autograd.grad(total, [move])
            bar.advance(task)
            return total.detach()

        optimiser.step(loss)  # type: ignore[no-untyped-call]
    return (latents + scale * move).detach()
