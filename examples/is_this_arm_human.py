# %% [markdown]
# # Is this arm human?
#
# A musculoskeletal model has muscles, tendons and bones of a person. Does its hand also feel like a person's to
# somebody who pushes it? This tutorial puts MyoArm, a model of the package
# [myo-sim](https://pypi.org/project/myo-sim/), into the laboratory at three levels of co-contraction, and compares its
# admittance and its stiffness at the hand with those of people who keep position. It needs the extras `sim` and `myo`;
# any other arm in MJCF goes the same way.
#
# ## The model in the laboratory
#
# The hand grips the handle at the middle finger's knuckle; cuffs hold wrist, forearm and fingers. Four multisines of
# 1 N push the handle for 32 s each, small enough for the arm to be nearly linear.

# %%
import matplotlib.pyplot as plt
import numpy as np

import armperturb as ap

POSTURE = {"shoulder_elv_r": 80.0, "elv_angle_r": 45.0, "shoulder_rot_r": 45.0, "elbow_flexion_r": 90.0}
CUFFED = ("pro_sup_r", "deviation_r", "flexion_r", "cmc*", "mp_*", "ip_*", "mcp*", "pm*", "md*")
LEVELS = (0.02, 0.1, 0.4)

recordings = {}
for level in LEVELS:
    laboratory = ap.Laboratory("myo_sim:myoarm_r", "3proxph_r", activation=level, posture_deg=POSTURE, locked=CUFFED)
    recordings[level] = laboratory.record([ap.Multisine.draw(rms=1.0, seed=seed) for seed in range(4)])
print(f"{laboratory.model.nv} degrees of freedom and {laboratory.model.nu} actuators, the manipulator's included")

# %% [markdown]
# ## Beside people
#
# `compare` draws 16 people of our cohort and pushes them with the same force. A distance of 1 is the standard deviation
# between people; `usual` is the distance from the others within which 95 % of the people lie.

# %%
likenesses = {level: ap.compare(recording, "people") for level, recording in recordings.items()}
for level, likeness in likenesses.items():
    distances = ", ".join(
        f"{group} {distance:.1f} (people {likeness.usual[group]:.1f})" for group, distance in likeness.distance.items()
    )
    print(f"co-contraction {level:4}: {distances}")

# %% [markdown]
# At low frequencies the admittance of the model is far above that of people who keep position, at every level.

# %% alt="Largest and smallest gain of the admittance at three levels of co-contraction, and those of people"
figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.4), sharey=True, layout="constrained")
for k, ax in enumerate(axes):
    first = likenesses[LEVELS[0]]
    low, middle, high = 1e3 * np.quantile(first.reference_gains[..., k], (0.025, 0.5, 0.975), axis=0)
    ax.fill_between(first.frequency, low, high, color="0.85", label="people, 95 %")
    ax.loglog(first.frequency, middle, color="0.5", label="people, median")
    for level, likeness in likenesses.items():
        ax.loglog(likeness.frequency, 1e3 * likeness.gains[:, k], label=f"MyoArm, co-contraction {level}")
    ax.set(title=("largest gain", "smallest gain")[k], xlabel="frequency [Hz]")
axes[0].set_ylabel("admittance [mm/N]")
axes[1].legend(fontsize=8)

# %% [markdown]
# ## Stiffness at the hand
#
# The ellipse of stiffness has a size (the geometric mean of its axes), a shape (their ratio) and an orientation.

# %%
for level, likeness in likenesses.items():
    table = likeness.to_frame().set_index("quantity")
    for name in [each for each in table.index if each.startswith("stiffness")]:
        row = table.loc[name]
        print(f"{level:4}  {name:26}{row['value']:9.3g} {row['unit']:5} people {row['mean']:.3g}")

# %% [markdown]
# Why the model is so soft is not tested here. Its muscles have no short-range stiffness, its tendons do not stretch,
# and no reflex is on. `ap.StretchReflex` adds delayed stretch reflexes (`controller=` of the laboratory), which is the
# next thing to try.
