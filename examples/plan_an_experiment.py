# %% [markdown]
# # Plan an experiment
#
# How many trials does it take to know a parameter within 10 %, and which perturbation needs fewer? This tutorial
# answers both from a pilot recording of the person, before the experiment. It needs the extra `sim`; the method is
# described in [Plan an experiment](../design.md).
#
# ## Who will be perturbed
#
# The pilot is the position task of `examples/data`. The identified arm, as far as the pilot determines it, is the
# person for whom the experiment is planned. Use the recording of a similar person, or `ap.POSITION`, if there is no
# pilot.

# %%
import math

import armperturb as ap

pilot, _ = ap.import_recording(["examples/data/position.csv"])
person = ap.identify(pilot, model="3b").fit.arm

# %% [markdown]
# ## The plan
#
# The goal is the reflexes, which are the hardest to determine. The limits per trial are those of the thesis's
# condition PT7.5: 5.4 N and 7.5 mm RMS per axis, and 32 s. The thesis's multisine, made as strong as the same limits
# allow, is the reference.

# %%
settings = ap.DesignSettings(
    subject=person, goal="reflex", force=5.4, displacement=0.0075, duration=32.0, model="3b", trials=2, seed=1
)
plan = ap.design(settings)
plan

# %% [markdown]
# The picture shows how standard errors fall with duration and number of trials, and where the optimised multisine has
# its power: at few frequencies, around those at which the reflexes show most.

# %% alt="Standard errors against duration and number of trials, and spectra of both multisines"
plan.plot()
# %% [markdown]
# ## How many trials?
#
# Standard errors fall with the root of the number of trials:

# %%
table = plan.to_frame()
for row in table[table["goal"] == 1].itertuples():
    needed = [math.ceil(2 * (sem / (0.1 * abs(row.value))) ** 2) for sem in (row.sem_thesis, row.sem_optimised)]
    print(f"{row.parameter:6} {row.value:6.2f}: 10 % after {needed[0]:3} trials of the thesis, {needed[1]:3} optimised")

# %% [markdown]
# Position feedback at the shoulder is next to nothing in this person, and 10 % of it is less than any experiment can
# tell: ask there for an error in Nm/rad.
#
# The prediction is a lower bound for a person who is the same in every trial and as the pilot says. [Known
# limits](../design.md#known-limits) of a plan include people who vary from trial to trial and muscles that are not
# linear.
#
# ## Use it
#
# Each trial has a realisation of its own, which a manipulator can play from a file:

# %%
for number, perturbation in enumerate(plan.perturbations, 1):
    ap.save_perturbation(perturbation, f"trial_{number}.csv", rate=200.0)
trials = [ap.Trial(subject=person, perturbation=played, seed=i) for i, played in enumerate(plan.perturbations)]
recording = ap.run_experiment(trials, instruments=ap.Instruments())
rms = 1e3 * float((recording["displacement"] ** 2).mean() ** 0.5)
print(f"RMS displacement in a simulation of the plan: {rms:.1f} mm per axis")

# %% [markdown]
# On the command line, `armperturb design --subject person.toml --goal reflex --force 5.4 --displacement 0.0075
# --duration 32 --out plan` writes tables, the picture and the perturbations.
