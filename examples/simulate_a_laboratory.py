# %% [markdown]
# # Simulate a laboratory and report
#
# This tutorial perturbs synthetic people, first in one trial and then in a small study with a report. The truth about
# these people is known, so an analysis can be judged before it is used on recordings of people. It needs the extra
# `sim`.
#
# ## One trial
#
# A person is drawn with a body, muscles and reflexes for both tasks. In the relax task, a multisine of 0.9 N RMS per
# axis runs for 32 s, followed by a pulse of 54 N. The [instruments](../laboratory.md#instruments) add the noise of
# strain gauge and encoders, and `HUMAN_NOISE` adds the person's own.

# %%
import matplotlib.pyplot as plt

import armperturb as ap

person = ap.draw_person(seed=0, number=0)
relaxed = person.subjects["RT"]
perturbation = ap.MultisineThenPulse.join(ap.Multisine.draw(seed=1, rms=0.9), peak=54.0, direction_deg=20.0, tail=2.0)
trial = ap.Trial(subject=relaxed, perturbation=perturbation, seed=1, noise=ap.HUMAN_NOISE["RT"], condition="RT7.5")
recording = ap.run_experiment([trial], instruments=ap.Instruments())
recording[["perturbation", "force", "displacement"]]

# %% [markdown]
# A recording is an `xarray.Dataset`. The pulse moves the relaxed hand much further than the multisine does:

# %% alt="Force and displacement of one trial over time"
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7.6, 4.0), layout="constrained")
axes[0].plot(recording["time"], recording["perturbation"][0], lw=0.7)
axes[0].set_ylabel("perturbation [N]")
axes[1].plot(recording["time"], 1e3 * recording["displacement"][0], lw=0.7, label=["x", "y"])
axes[1].set(xlabel="time [s]", ylabel="displacement [mm]")
axes[1].legend(frameon=False)

# %% [markdown]
# ## Judge an analysis by the truth
#
# A linear person has true parameters, which the estimates should recover. A person with nonlinear muscles (the
# default) has none: an estimate then describes the movement of one condition. Two trials of each are recorded and
# identified:


# %%
def record(subject):
    """Two trials of 32 s of a relaxed person."""
    seeds = range(2)
    trials = [ap.Trial(subject=subject, perturbation=ap.Multisine.draw(seed=i, rms=0.9), seed=i) for i in seeds]
    return ap.run_experiment(trials, instruments=ap.Instruments())


linear = ap.draw_person(seed=0, number=0, muscles="linear").subjects["RT"]
for name, subject in {"linear muscles": linear, "nonlinear muscles": relaxed}.items():
    recorded = record(subject)
    arm = ap.identify(recorded, model="1")
    low, high = arm.fit.interval("k_s")
    share = ap.best_linear(recorded).share.mean()
    print(f"{name}: k_s = {low:.2f} to {high:.2f} Nm/rad, true {subject.k_s:.2f}; nonlinear distortion {share:.1%}")

# %% [markdown]
# ## A study
#
# A study takes a cohort through a protocol: practice finds each person's forces, all trials are recorded, identified
# and summarised. The default is the [thesis's protocol](../protocol.md) with 32 trials per person, which takes
# minutes. A protocol is a TOML file; this one has one condition with a fixed force, and the two people have linear
# muscles, so that the report can compare estimates with the truth:

# %%
from pathlib import Path

Path("small.toml").write_text("""
forces = "published"

[[conditions]]
name = "hold"
task = "PT"
rms_displacement = 0.0075
published_force = 5.4
pulse_levels = [1]
""")
settings = ap.StudySettings(subjects=2, protocol=Path("small.toml"), muscles="linear")
study = ap.run_study(settings, Path("study"), show_progress=False)
report = ap.write_report(study, Path("study"), show_progress=False)
print(f"{report}: {report.stat().st_size / 1e6:.1f} MB, {len(list(Path('study/figures').iterdir()))} figures")

# %% [markdown]
# The report is one HTML file that needs no network; [Numbers of the report](../report.md) defines each number in it.
# All tables are CSV files as well. An interrupted study continues when it is run again.

# %%
import pandas as pd

columns = ["subject", "parameter", "unit", "true", "estimated", "lower_95", "upper_95"]
table = pd.read_csv("study/tables/estimates.csv")[columns]
print(table.head(8).round(2).to_string(index=False))

# %% [markdown]
# The intervals that are shown hold the truth. They are wide, because people who keep the position add torque of their
# own, which two trials do not average out; the default protocol has eight in this condition. The muscles of these
# people also vary by 8 % from trial to trial, which intervals from two trials cannot contain
# ([Identification](../method.md#accuracy-in-a-study)).
#
# On the command line the same is
#
# ```sh
# armperturb study --protocol small.toml --subjects 2 --muscles linear --out study
# armperturb report study
# armperturb score study
# ```
#
# and on a cluster, where a study of a thousand people is recorded by the workers of a Dask scheduler,
#
# ```sh
# armperturb study --subjects 1000 --record-only --dask tcp://HOST:8786 --out large
# ```
#
# The next tutorial [plans an experiment](plan_an_experiment.md).
