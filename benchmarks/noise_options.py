"""Options of the benchmarks that try another remnant in the position task than people have."""

import argparse
from dataclasses import replace

from armperturb.controllers.remnant import HUMAN_NOISE, HumanNoise

_OPTIONS = {
    "cutoff": ("remnant_cutoff", "of the remnant's slow part [Hz]"),
    "share": ("remnant_share", "RMS of the slow part over the demand"),
    "floor": ("remnant_floor", "RMS of the slow part without a perturbation [Nm]"),
    "fast_cutoff": ("fast_cutoff", "of the remnant's fast part [Hz]"),
    "fast_share": ("fast_share", "RMS of the fast part over the demand; 0 takes it away"),
    "voluntary": ("voluntary_share", "RMS of slow voluntary corrections over the demand"),
}


def add_noise_options(parser: argparse.ArgumentParser) -> None:
    """Add an option for each number of the noise that can be tried; what is not given is as people have it."""
    group = parser.add_argument_group("noise of people, as they have it where not given")
    for name, (_, text) in _OPTIONS.items():
        group.add_argument(f"--{name.replace('_', '-')}", type=float, help=text)


def noise_of(options: argparse.Namespace, task: str) -> HumanNoise:
    """The task's noise with the numbers that were given."""
    given = {field: getattr(options, name) for name, (field, _) in _OPTIONS.items()}
    return replace(HUMAN_NOISE[task], **{field: value for field, value in given.items() if value is not None})
