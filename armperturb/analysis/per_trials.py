"""Results that several estimators need are computed once, and kept with the trials."""

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

from armperturb.analysis.trials import ConditionTrials, Trials, prepared

P = ParamSpec("P")
T = TypeVar("T")


def per_trials(function: Callable[Concatenate[ConditionTrials, P], T]) -> Callable[Concatenate[Trials, P], T]:
    """Decorator: the result for the same trials and options is computed once, and kept with the trials.

    Args:
      function: of prepared trials and hashable options.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def remembered(trials: Trials, *args: P.args, **options: P.kwargs) -> T:
        ready = prepared(trials)
        call = signature.bind(ready, *args, **options)
        call.apply_defaults()
        # By name: the function that a decorator replaced cannot be pickled.
        key = (function.__module__, function.__qualname__, tuple(call.arguments.items())[1:])
        if key not in ready.results:
            ready.results[key] = function(ready, *args, **options)
        return ready.results[key]

    return remembered
