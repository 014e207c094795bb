"""Random streams and seeds that depend on a study's seed and on their purpose, and on nothing else."""

import numpy as np

from armperturb.validation import require_whole


def random_stream(seed: int, purpose: str, *numbers: int) -> np.random.SeedSequence:
    """A stream of random numbers of its own for each purpose: "order" of person 1 has nothing to do with "onset".

    Args:
      seed: of the study or cohort, >= 0.
      purpose: what is drawn.
      *numbers: which of them, such as the person's number, >= 0.
    """
    return np.random.SeedSequence(seed, spawn_key=(*purpose.encode(), *numbers))


def trial_seed(seed: int, purpose: str, *numbers: int) -> int:
    """A seed of 63 bits for `Trial.seed`, so that thousands of people never share one; arguments as `random_stream`."""
    return int(random_stream(seed, purpose, *numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))


def generator_of(owner: str, seed: int | np.random.Generator) -> np.random.Generator:
    """The generator that a user's seed stands for.

    Args:
      owner: what asks, for the message.
      seed: >= 0, or a generator, which stands for itself.

    Raises:
      TypeError: seed is neither a whole number nor a generator.
      ValueError: it is negative.
    """
    if not isinstance(seed, np.random.Generator):
        require_whole(owner, "seed", seed, at_least=0)
    return np.random.default_rng(seed)
