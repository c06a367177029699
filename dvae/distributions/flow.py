"""The QR flow: layers of an orthogonal and a triangular matrix with leaky rectifiers between them.

    z^l = Q^l R^l x^l + b^l,        x^{l+1} = PReLU(z^l) for all layers but the last,        z^L ~ N(0, I)

The pose prior of GSPS (Mao, Liu and Salzmann, 2021, arXiv 2108.08422). Q is a product of as many Householder
reflections as there are dimensions, H_1 H_2 ... H_D with H_i = I - 2 v_i v_i' / |v_i|^2. With the v_i as the rows of V
it is, in closed form,

    Q = I - V' S^-1 V,        S = the part of V V' above the diagonal, and half of the diagonal

(the compact WY form; Joffrain et al., 2006, ACM TOMS 32), a triangular solve in place of D dependent steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from pyro.distributions.torch_distribution import TorchDistribution
from torch import Tensor, nn
from torch.distributions import constraints
from typing_extensions import override

from .base import Shape
from .priors import Prior


@dataclass(frozen=True)
class QRFlow:
    """The law of a vector without parents that a bijection of R^D with a known determinant gives. See the file.

    The diagonal of R is the exponential of that of `triangular`, whose part below it is unused. Ours: the parameter of
    a PReLU is the logarithm of its slope, which so stays positive; and the first layer reads W (x - m), where location
    m and whitening W are no parameters: 0 and the identity, unless `whiten` took them from data.

    Args:
        layers: L.
    """

    layers: int = 3

    def build(self, shape: Shape) -> QRFlowLaw:
        """The law of a static latent without parents.

        Raises:
            ValueError: a size or number of layers below 1.
        """
        return QRFlowLaw(self, shape)


class QRFlowLaw(Prior):
    """What `QRFlow` describes."""

    def __init__(self, spec: QRFlow, shape: Shape):
        super().__init__(spec, shape)
        size, layers = shape.size, spec.layers
        if size < 1 or layers < 1:
            raise ValueError(f"a QRFlow has size {size} and {layers} layers; both must be at least 1")
        self.size = size
        bound = size**-0.5
        self.triangular = nn.Parameter(torch.empty(layers, size, size).uniform_(-bound, bound))
        self.reflections = nn.Parameter(nn.functional.normalize(torch.randn(layers, size, size), dim=-1))
        self.bias = nn.Parameter(torch.empty(layers, size).uniform_(-bound, bound))
        self.log_slope = nn.Parameter(torch.full((layers - 1,), math.log(0.25)))
        self.location: Tensor
        self.whitening: Tensor
        self.register_buffer("location", torch.zeros(size))
        self.register_buffer("whitening", torch.eye(size))

    def factors(self) -> tuple[Tensor, Tensor]:
        """Q and R of every layer, (L, D, D) each.

        Raises:
            ValueError: parameters in half precision, in which no triangular system is solved.
        """
        v = self.reflections
        if torch.finfo(v.dtype).bits < 32:
            raise ValueError(f"a QRFlow has no half precision, but its parameters are {v.dtype}; use mixed precision")
        gram = v @ v.mT
        s = gram.triu(1) + torch.diag_embed(gram.diagonal(dim1=1, dim2=2) / 2)
        identity = torch.eye(self.size, dtype=v.dtype, device=v.device)
        q = identity - v.mT @ torch.linalg.solve_triangular(s, v, upper=True)
        diagonal = self.triangular.diagonal(dim1=1, dim2=2)
        return q, self.triangular.triu(1) + torch.diag_embed(diagonal.exp())

    @override
    def prior(self) -> FlowDistribution:
        return FlowDistribution(self, self.bias[0])

    def to_noise(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The noise that stands for a value.

        Args:
            x: (..., D).

        Returns:
            z (..., D), standard normal where x is from this distribution, and log |det dz/dx| (...).

        Raises:
            ValueError: another size.
        """
        self._check(x)
        with torch.autocast(x.device.type, enabled=False):
            q, r = self.factors()
            matrices = list((q @ r).unbind())
            matrices[0] = matrices[0] @ self.whitening
            biases = list(self.bias.unbind())
            biases[0] = biases[0] - matrices[0] @ self.location
            log_det = self.triangular.diagonal(dim1=1, dim2=2).sum() + self.whitening.diagonal().log().sum()
            z, log_det = x.to(q.dtype), log_det.expand(x.shape[:-1])
            for layer, (matrix, bias) in enumerate(zip(matrices, biases, strict=True)):
                if layer:
                    log_slope = self.log_slope[layer - 1]
                    log_det = log_det + log_slope / 2 * (self.size - z.sign().sum(-1))
                    # prelu's backward makes a gradient of the slope per entry, also of a fixed slope: 17 ms against 8
                    z = torch.lerp(z.relu(), z, log_slope.exp())
                z = nn.functional.linear(z, matrix, bias)
        return z, log_det

    def from_noise(self, z: Tensor) -> Tensor:
        """The value x (..., D) for which noise z (..., D) stands."""
        self._check(z)
        with torch.autocast(z.device.type, enabled=False):
            q, r = self.factors()
            x = z.to(q.dtype)
            for layer in reversed(range(len(self.bias))):
                x = (x - self.bias[layer]) @ q[layer]
                x = torch.linalg.solve_triangular(r[layer].mT, x, upper=False, left=False)
                if layer:
                    x = torch.lerp(x.relu(), x, (-self.log_slope[layer - 1]).exp())
            x = torch.linalg.solve_triangular(self.whitening.mT, x, upper=True, left=False)
        return x + self.location

    @torch.no_grad()
    def whiten(self, values: Tensor) -> None:
        """Sets location and whitening so that these values enter the first layer with mean 0 and unit covariance.

        What the family of distributions holds stays the same, but the parameters then learn of directions in which the
        values vary little as fast as of others. Directions in which they hardly vary are widened, to 1e-9 of the mean
        variance.

        Args:
            values: (..., D), more than D of them.

        Raises:
            ValueError: another size, or too few values.
        """
        self._check(values)
        values = values.detach().reshape(-1, self.size).double()
        if len(values) <= self.size:
            raise ValueError(f"to whiten {self.size} dimensions takes more than {self.size} values, got {len(values)}")
        covariance = values.T.cov().reshape(self.size, self.size)
        identity = torch.eye(self.size, dtype=values.dtype, device=values.device)
        least = 1e-9 * covariance.diagonal().mean().clamp(min=torch.finfo(torch.float32).tiny)
        root = torch.linalg.cholesky(covariance + least * identity)
        self.location.copy_(values.mean(0))
        self.whitening.copy_(torch.linalg.solve_triangular(root, identity, upper=False))

    def _check(self, value: Tensor) -> None:
        if value.shape[-1:] != (self.size,):
            raise ValueError(f"a QRFlow of size {self.size} takes (..., {self.size}), got {tuple(value.shape)}")


class Bijection(Protocol):
    """A bijection of R^D between values and noise."""

    def to_noise(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The noise (..., D) that stands for values (..., D), and log |det| (...) of the Jacobian."""
        ...

    def from_noise(self, z: Tensor) -> Tensor:
        """The values (..., D) for which noise (..., D) stands."""
        ...


class FlowDistribution(TorchDistribution):
    """The density that a bijection gives standard normal noise: exact log density, exact draws.

    Args:
        flow: from values to noise.
        like: a tensor (..., D) of their size, type and device.
        batch_shape: of independent values.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    support = constraints.real_vector
    has_rsample = True

    def __init__(self, flow: Bijection, like: Tensor, batch_shape: Any = ()):
        self.flow, self.like = flow, like
        super().__init__(torch.Size(batch_shape), like.shape[-1:], validate_args=False)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draws (*sample_shape, *batch_shape, D)."""
        shape = self._extended_shape(torch.Size(sample_shape))
        return self.flow.from_noise(torch.randn(shape, dtype=self.like.dtype, device=self.like.device))

    def log_prob(self, value: Tensor) -> Tensor:
        """log p (...) of values (..., D), in nats."""
        noise, log_det = self.flow.to_noise(value)
        found = log_det - noise.square().sum(-1) / 2 - self.event_shape[0] / 2 * math.log(2 * math.pi)
        return found.expand(torch.broadcast_shapes(found.shape, self.batch_shape))

    def expand(self, batch_shape: Any, _instance: object = None) -> FlowDistribution:
        """With another batch shape."""
        return FlowDistribution(self.flow, self.like, batch_shape)
