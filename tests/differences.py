"""Where two results differ."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import pandas as pd


def differences(a, b, where="result", rel=0.0):
    """Where two values differ, however deep, by more than a share of them; NaN equals NaN."""
    if type(a) is not type(b):
        return [f"{where}: {type(a)} and {type(b)}"]
    if dataclasses.is_dataclass(a):
        names = [field.name for field in dataclasses.fields(a)]
        return [d for name in names for d in differences(getattr(a, name), getattr(b, name), f"{where}.{name}", rel)]
    if isinstance(a, np.ndarray):
        if a.dtype != b.dtype or a.shape != b.shape or a.dtype.kind not in "fc":
            return [] if np.array_equal(a, b) else [where]
        return [] if np.allclose(a, b, rtol=rel, atol=0.0, equal_nan=True) else [where]
    if isinstance(a, pd.DataFrame):
        return differences(a.to_dict("list"), b.to_dict("list"), where, rel)
    if isinstance(a, Mapping):
        if list(a) != list(b):
            return [f"{where}: {list(a)} and {list(b)}"]
        return [d for key in a for d in differences(a[key], b[key], f"{where}[{key}]", rel)]
    if isinstance(a, list | tuple):
        if len(a) != len(b):
            return [f"{where}: {len(a)} and {len(b)} long"]
        return [d for k, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{where}[{k}]", rel)]
    if isinstance(a, float):
        return [] if np.allclose(a, b, rtol=rel, atol=0.0, equal_nan=True) else [f"{where}: {a} and {b}"]
    return [] if a == b else [f"{where}: {a} and {b}"]
