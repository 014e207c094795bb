"""The amplifier of the EMG, compiled: only who records EMG needs the compiler."""

import numpy as np
from numpy.typing import NDArray

from armperturb.jit import compiled
from armperturb.recording import MUSCLES

Float32 = NDArray[np.float32]


@compiled(nogil=True)
def amplify(
    white: Float32,
    amplitude: Float32,
    mixing: Float32,
    colour: Float32,
    amplifier: Float32,
    noise: np.float32,
    step: np.float32,
    work: Float32,
    volts: Float32,
) -> None:
    """What the converter reads of white noise; the compiler makes one vector instruction of the muscles' scalar ones.

    Args:
      white: noise of unit RMS of the muscles and then of their electrodes, (2 muscle, sample).
      amplitude: of the muscles [V], (sample, muscle).
      mixing: share of each muscle's signal that each electrode picks up, symmetric, (muscle, electrode).
      colour: second-order sections, (section, 6).
      amplifier: likewise.
      noise: of the electrodes [V].
      step: of the converter, which has 16 bits [V].
      work: state of the sections, two rows each, which goes on, and room for two rows, (row, muscle).
      volts: to fill, (sample, muscle).
    """
    n_colour, n_muscles, value, mixed = len(colour), len(MUSCLES), len(work) - 2, len(work) - 1
    for sample in range(len(amplitude)):
        for muscle in range(n_muscles):
            work[value, muscle] = white[muscle, sample]
        for section in range(n_colour + len(amplifier)):
            if section == n_colour:
                for muscle in range(n_muscles):
                    work[value, muscle] *= amplitude[sample, muscle]
                    work[mixed, muscle] = noise * white[n_muscles + muscle, sample]
                for source in range(n_muscles):
                    signal = work[value, source]
                    for muscle in range(n_muscles):
                        work[mixed, muscle] += mixing[source, muscle] * signal
                for muscle in range(n_muscles):
                    work[value, muscle] = work[mixed, muscle]
            b = colour[section] if section < n_colour else amplifier[section - n_colour]
            b_0, b_1, b_2, a_1, a_2 = b[0], b[1], b[2], b[4], b[5]
            z = 2 * section
            for muscle in range(n_muscles):
                given = work[value, muscle]
                filtered = b_0 * given + work[z, muscle]
                work[z, muscle] = b_1 * given - a_1 * filtered + work[z + 1, muscle]
                work[z + 1, muscle] = b_2 * given - a_2 * filtered
                work[value, muscle] = filtered
        for muscle in range(n_muscles):
            counts = min(max(np.rint(work[value, muscle] / step), np.float32(-(2**15))), np.float32(2**15 - 1))
            volts[sample, muscle] = counts * step
