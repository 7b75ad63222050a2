"""Bounds over a box from samples, for models that cannot do better."""

import numpy as np

from dtmpc_drake.models.base import Model
from dtmpc_drake.numerics.arrays import Array


class SampledBoxBounds(Model):
    """Bounds over a box from its corners and its centre: *not* certified.

    The maximum over the corners is a bound only where the functions are
    monotone in every coordinate (the paper's Theorem 2 takes this for
    granted).  A model that can do better overrides the methods; until then
    its plans say that their bounds were sampled.
    """

    def _corners(self, x: Array, radius: Array) -> Array:
        n, m = self.order, self.num_outputs
        signs = np.stack(
            np.meshgrid(*[(-1.0, 1.0)] * (n * m), indexing="ij"), axis=-1
        ).reshape(-1, n, m)
        signs = np.concatenate([np.zeros((1, n, m)), signs])
        lead = (1,) * (x.ndim - 2)
        return x + signs.reshape(-1, *lead, n, m) * radius

    def drift_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return np.abs(self.drift(self._corners(x, radius))).max(axis=0)

    def model_error_bound_over(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model_error_bound(self._corners(x, radius)).max(axis=0)

    def model_error_bound_under(self, x: Array, radius: Array) -> Array:
        """See base class."""
        return self.model_error_bound(self._corners(x, radius)).min(axis=0)

    @property
    def bounds_certified(self) -> bool:
        """See base class."""
        return False
