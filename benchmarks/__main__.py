"""Runs the benchmarks that take minutes; `distortion` and `design` take an hour each, and are run by themselves."""

from benchmarks import (
    batch_overhead,
    estimators,
    frequency_response,
    multisine_crest,
    muscle_law,
    nonlinear,
    nonparametric,
    study_kills,
    study_report,
    study_speed,
    sysid,
    thesis_fit,
    thesis_sem,
    vector_env,
)

for module in (
    batch_overhead,
    muscle_law,
    vector_env,
    multisine_crest,
    thesis_fit,
    thesis_sem,
    estimators,
    nonparametric,
    frequency_response,
    sysid,
    study_speed,
    study_report,
    study_kills,
    nonlinear,
):
    print(f"== {module.__name__}")
    module.main()
