"""Human-arm perturbation experiments on synthetic people in MuJoCo, and their analysis.

The public names stand in `__init__.pyi`. Each is imported when it is first used, so that `import armperturb` is quick
and an analysis of recordings needs no simulator.
"""

import importlib.metadata
from typing import Any

import lazy_loader

from armperturb.envs.learning.registration import register_environments
from armperturb.extras import naming_the_extra

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":  # of what is installed, which takes a while to find
        return importlib.metadata.version(__name__)
    with naming_the_extra(f"armperturb.{name}"):
        return _attribute(name)


register_environments()
