"""The public names: complete, quick to import, and clear about what an optional part needs."""

import inspect
import subprocess
import sys

import numpy as np
import pytest

import armperturb

NAMES = """
Subject anthropometric_body POSITION RELAX MuscleLaw Person draw_cohort draw_person average_person
Environment Strap Trial Instruments HumanNoise HUMAN_NOISE run_experiment build_model Laboratory StretchReflex
JointPerson JointTrial Servo run_joint_experiment
Multisine MultisineThenPulse Pulse Sampled load_perturbation save_perturbation
make_recording load_recording save_recording stack_trials import_recording export_recording
write_sidecar
identify identify_conditions identify_joint identify_nonlinear identify_varying
envelopes activity onsets reflexes UseOfEmg ElectromechanicalDelay
response best_linear arm_admittance plot
Structure STRUCTURES load_structure save_structure ConditionTrials variance_accounted_for
Protocol Condition load_protocol StudySettings run_study analyse_study write_report score design DesignSettings
validate ValidateSettings calibrate measure_cohort compare
load_dm_env record_agent trained_policy write_video
Emg AnalysisSettings Replay Clip composed inertia_prior in_start_geometry
"""
HEAVY = {"numpy", "scipy", "xarray", "pandas", "matplotlib", "numba", "gymnasium", "mujoco", "dm_control", "joblib"}
KNOWN = "assert gym.spec('ArmPerturb/Pulse-v1').vector_entry_point"


def in_python(*lines):
    """What a fresh interpreter prints that runs these lines."""
    run = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return run.stdout.strip()


def test_the_names_are_complete():
    assert set(dir(armperturb)) == set(armperturb.__all__) == set(NAMES.split())
    for name in dir(armperturb):
        assert getattr(armperturb, name) is not None
    with pytest.raises(AttributeError):
        armperturb.estimate  # noqa: B018


def test_what_is_missing_is_refused_in_one_line_that_says_what_was_expected():
    for name in sorted(set(dir(armperturb)) - {"ConditionTrials", "Replay"}):  # which `prepare` and `of_trial` make
        value = getattr(armperturb, name)
        if not callable(value):
            continue
        wanted = [each for each in inspect.signature(value).parameters.values() if each.default is each.empty]
        positional = [None for each in wanted if each.kind is each.POSITIONAL_OR_KEYWORD]
        by_name = {each.name: None for each in wanted if each.kind is each.KEYWORD_ONLY}
        if positional or by_name:
            with pytest.raises((TypeError, ValueError), match=r"^[^\n]*expected [^\n]*$"):
                value(*positional, **by_name)


def test_importing_is_quick_and_loads_no_heavy_library():
    clock, loaded = in_python(
        "import sys, time",
        "start = time.process_time()",
        "import armperturb",
        "print(time.process_time() - start)",
        f"print({HEAVY} & set(sys.modules))",
    ).splitlines()
    assert float(clock) < 0.3
    assert loaded == "set()"


# `test_extras` has gymnasium import the package by the name of an environment.
@pytest.mark.slow(reason="a process for each")
@pytest.mark.parametrize(
    "lines",
    [
        ("import gymnasium as gym", "import armperturb", KNOWN),
        ("import armperturb", "import gymnasium as gym", KNOWN),
    ],
    ids=["gymnasium first", "armperturb first"],
)
def test_gymnasium_knows_the_environments(lines):
    in_python(*lines)


def test_what_holds_signals_has_a_short_text():
    samples = np.zeros((1000, 2))
    made = armperturb.make_recording(
        {"perturbation": samples[None] + 1.0, "force": samples[None], "displacement": samples[None]},
        {"subject": ["A"], "task": ["RT"], "condition": ["RT7.5"], "repetition": [0], "pulse_level": [0.0]}
        | {name: [np.nan] for name in ("pulse_direction", "pulse_onset", "limit_time")}
        | dict(l_h=[0.33], l_f=[0.34], theta_s_deg=[22.5], theta_e_deg=[82.3]),
        200.0,
    )
    assert repr(armperturb.ConditionTrials.prepare(made)) == "<A in RT7.5: 1 x 5 s>"
    played = armperturb.Sampled(force=samples, rate=200.0)
    drawn = armperturb.Multisine.draw(seed=0, rms=1.0, duration=5.0)
    for perturbation in (played, drawn):
        assert "array" not in repr(armperturb.Trial(subject=armperturb.RELAX, perturbation=perturbation))
