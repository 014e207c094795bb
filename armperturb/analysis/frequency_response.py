"""A frequency response and how well it is known."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class FrequencyResponse:
    """An estimated frequency response.

    Attributes:
      frequency: [Hz], (frequency,).
      response: complex, (frequency, output, input).
      covariance: variance of each complex element, the mean of |error|^2, (frequency, output, input); None where the
        method gives none.
      what: of which system, e.g. "arm".
    """

    frequency: NDArray[np.float64]
    response: NDArray[np.complex128]
    covariance: NDArray[np.float64] | None
    what: str
