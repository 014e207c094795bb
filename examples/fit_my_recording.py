# %% [markdown]
# # Fit my recording
#
# This tutorial goes from files of a laboratory to the parameters of an arm with confidence intervals. The data are in
# `examples/data`: two trials of the position task, with the names, units, signs and axes of an imaginary laboratory.
# They are simulated, so the truth is known and the result can be judged at the end. Run it from a checkout, and
# replace the file by your own.
#
# ## Read and check
#
# A [sidecar](../recordings.md#the-sidecar), here `position.json`, declares what the columns of `position.csv` mean.
# `write_sidecar` writes a first version of it from the names and numbers in the file and lists every guess to check. Of
# this laboratory, x points to the left, and the segment lengths are the person's own. Reading converts units, signs and
# axes and checks them against physics: disturbance minus hand force must move the manipulator.

# %%
import json
import textwrap
from pathlib import Path

import numpy as np

import armperturb as ap

data = Path("examples/data")
Path("first_version.json").unlink(missing_ok=True)  # of an earlier run: no sidecar is overwritten
print(*ap.write_sidecar(data / "position.csv", "first_version.json").notes, sep="\n")

recording, notes = ap.import_recording([data / "position.csv"])
print(f"{recording.sizes['trial']} trials of {recording.sizes['time'] / recording.attrs['rate']:g} s, notes: {notes}")

# %% [markdown]
# Look at it before any analysis: the hand should give way to the force.

# %% alt="Perturbation, hand force and displacement of the first trial over time"
ap.plot(recording)

# %% [markdown]
# What if the sidecar is wrong? Suppose that the sensor measured the force of the hand on the handle, and somebody
# declared the opposite. The recording is refused with the reason:

# %%
sidecar = json.loads((data / "position.json").read_text())
sidecar["signals"]["force"]["exerted_by"] = "handle"
Path("wrong.json").write_text(json.dumps(sidecar))
try:
    ap.import_recording([data / "position.csv"], sidecar="wrong.json")
except ValueError as error:
    print(textwrap.fill(str(error), 110))

# %% [markdown]
# ## The admittance, without a model
#
# The frequency response from force to displacement needs no model of the arm. It shows at which frequencies the
# recording says anything: where the confidence bands are wide, a fit has nothing to rely on. The person resists at
# low frequencies, resonates at about 4 Hz, and is dominated by the arm's mass above.

# %% alt="Gain and phase of the admittance with 95 % bands"
admittance = ap.response(recording)
radius = np.median(admittance.radius() / np.abs(admittance.response))
print(f"{len(admittance.frequency)} frequencies; 95 % confidence radius {radius:.0%} of the gain (median)")
admittance.plot()
# %% [markdown]
# ## The parameters of the arm
#
# Model 3b has intrinsic damping and stiffness and reflexes of velocity and position. It needs no initial guess. Read
# the remarks before the numbers: they name parameters that are poorly determined, not separately identifiable or at a
# bound, and say if the structure does not fit the data.

# %%
arm = ap.identify(recording, model="3b")
arm

# %% [markdown]
# The fitted admittance should pass through the estimates; here it does. The estimates come from averages over four
# lines, which blur the resonance; the fit uses every line.

# %% alt="Estimated admittance and that of the fitted arm"
arm.plot()
# %% [markdown]
# ## Is it right?
#
# For a person nobody knows. Here the truth lies beside the data. An interval of 95 % misses the truth once in twenty
# times; total mass is an exception that no interval shows: model 3b takes the upper arm for 49 % of the arm's mass,
# and this person's share is 52 %.
#
# These two trials are less noisy than those of a [simulated study](simulate_a_laboratory.md), whose people also add
# fast torque while they keep the position. Two trials of this person with that noise (`python examples/data/make.py
# FOLDER`) give intervals that are 2 to 18 times as wide, that of the mass 50 times, and `kp_s` ends at its bound of 0.

# %%
truth = json.loads((data / "truth.json").read_text())["position"]
table = arm.to_frame()[["parameter", "value", "lower_95", "upper_95", "unit"]]
table["truth"] = table["parameter"].map(truth)
table["inside"] = table["truth"].between(table["lower_95"], table["upper_95"])
print(table.round(2).to_string(index=False))

# %% [markdown]
# ## Is the arm linear?
#
# A linear model describes a person around one movement. From two or more realisations of a multisine, the nonlinear
# distortion can be separated from noise. The relax task of the example data is of a person with nonlinear muscles:

# %% alt="Linear response, noise and nonlinear distortion against frequency"
relaxed = ap.load_recording(data / "relax.nc")
linear = ap.best_linear(relaxed)
print("\n".join(repr(linear).splitlines()[:3]))
linear.plot()

# %% [markdown]
# Such a person needs [nonlinear identification](../nonlinear.md): `ap.identify_nonlinear` fits the muscle law itself
# to trials of several amplitudes. The next tutorial [simulates a laboratory](simulate_a_laboratory.md).
