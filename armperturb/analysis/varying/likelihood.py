"""Likelihood of the torque of a joint whose parameters change: that of a joint, with another model.

In an ensemble, what the repetitions have in common at each instant is taken out of torque and model, and the noise has
a smooth, unknown spectrum. Over a scheduling variable the noise is taken to be white: what the model lacks outweighs
the noise there, and weights would fit the high frequencies at the cost of the torque that is to be predicted.
"""

import copy
from collections.abc import Iterator, Mapping

import numpy as np
from scipy import sparse

from armperturb.analysis.fit.frequency_rows import applied_rows
from armperturb.analysis.fit.whittle import ALL
from armperturb.analysis.joint.torque_likelihood import BlockScore, TorqueLikelihood
from armperturb.analysis.varying.model import VaryingModel
from armperturb.arrays import Array, ComplexArray

STRETCH = 2.5
"""Length of the stretches of a single record that are left out in turn [s]."""


class VaryingLikelihood(TorqueLikelihood):
    """Likelihood of trials with one number of splines for each quantity.

    Args:
      model: of the torque.
      ensemble: whether trials are repetitions of the same course of parameters.
    """

    def __init__(self, model: VaryingModel, *, ensemble: bool) -> None:
        self.model = model
        self._remembered: dict[tuple[str, int, bytes], ComplexArray] = {}
        used = model.signals.used
        duration = (used.stop - used.start) / model.signals.rate
        self._n_blocks = 1 if ensemble else max(int(duration / STRETCH), 1)
        super().__init__(model.signals, tapered=0.0 if ensemble else 1.0, centred=ensemble, white=not ensemble)

    def with_orders(self, orders: Mapping[str, int]) -> "VaryingLikelihood":
        """The same with other numbers of splines, and the noise as last weighed."""
        other = copy.copy(self)
        other.model, other._latest = self.model.with_orders(orders), (b"", self._observed)
        return other

    @property
    def n_groups(self) -> int:
        """Trials or stretches, of which a part is left out in turn."""
        return self.n_trials * self._n_blocks

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        return self._spectrum(self.model.torque(values))[trials]

    def _slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        model = self.model
        parts = [self._spectrum(self.signals.acceleration)[None]]
        parts += [self._columns(quantity, values) for quantity in model.orders]
        if mixing[model.n_linear :].any():
            parts.append(self._spectrum(np.stack(model.slopes(values))))
        columns = np.concatenate(parts)
        chosen = sparse.csr_array(mixing[: len(columns)].T) @ columns.reshape(len(columns), -1)
        yield ALL, chosen.reshape(-1, *columns.shape[1:])

    def _columns(self, quantity: str, values: Array) -> ComplexArray:
        """DFT of the torque of each spline of a quantity, (basis, trial, 1, line)."""
        key = quantity, self.model.orders[quantity], values[self.model.n_linear :].tobytes() * (quantity == "gain")
        if key not in self._remembered:
            for other in [each for each in self._remembered if each[0] == "gain" == quantity and each[2] != key[2]]:
                del self._remembered[other]
            self._remembered[key] = np.stack([self._spectrum(each) for each in self.model.columns(quantity, values)])
        return self._remembered[key]

    def scores(self, values: Array, mixing: Array) -> list[BlockScore]:
        """What each trial says of the parameters, or each stretch of a single record."""
        (_, slopes) = next(self._slopes(values, mixing))
        white = self._left(applied_rows(self._white, slopes))
        return self.block_scores(self.residual(values), white, self._n_blocks)
