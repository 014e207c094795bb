"""Who was perturbed, as a recording says."""

from dataclasses import replace

import xarray as xr

from armperturb.subject import POSITION, RELAX, TASKS, Subject


def body_of(recording: xr.Dataset) -> Subject:
    """Task, segment lengths and posture of the one person in a recording, in a subject whose muscles do not matter.

    Raises:
      ValueError: trials differ in subject, condition or posture, or the task is unknown.
    """
    found = {}
    for name in ("subject", "task", "condition", "l_h", "l_f", "theta_s_deg", "theta_e_deg"):
        values = list(dict.fromkeys(recording[name].values.tolist()))
        if len(values) > 1:
            raise ValueError(
                f"the recording holds several values of {name} ({', '.join(map(str, values))}); expected one"
            )
        found[name] = values[0]
    if found["task"] not in TASKS:
        raise ValueError(f"task = {found['task']!r}; expected one of {', '.join(TASKS)}")
    found.pop("condition")
    name = found.pop("subject")
    return replace(POSITION if found["task"] == "PT" else RELAX, name=name, **found)
