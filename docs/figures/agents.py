"""Trained agents as the laboratory sees them: films, and their admittance and stiffness compared with people's.

Run `python docs/figures/agents.py FOLDER`. It records the policies that the package ships, writes a film of each,
compares those that meet a multisine with 16 people of the cohort, and writes agent_admittance.png into FOLDER.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.ticker import NullFormatter

import armperturb as ap
from armperturb.analysis.defaults import WINDOW_START
from armperturb.envs.render.clip import Clip
from armperturb.envs.render.replay import Replay
from armperturb.plots.style import COLOURS, GREY, INK, PALE, PALETTE, in_style, new_figure, save_png
from armperturb.study.comparison.likeness import HIGHEST, impedance_matrices

FORCE = {"Position": 5.4, "Relax": 0.9}
FILMS = {"Position": (10.0, 14.0, 1.0), "Relax": (10.0, 14.0, 1.0), "Pulse": (0.9, 1.7, 6.0)}
"""Task to what a film shows of a trial: start and stop [s], and how many times slower."""

N_PEOPLE, N_TRIALS = 16, 4


def subject(task):
    """The person whose arm the agents have."""
    return ap.average_person().subjects["RT" if task == "Relax" else "PT"]


def trials(task, person):
    """Multisines of the environment's force, without the person's noise."""
    return [
        ap.Trial(subject=person, perturbation=ap.Multisine.draw(seed=seed, rms=FORCE[task])) for seed in range(N_TRIALS)
    ]


def agents(task):
    """The trained policy, and the person's own action."""
    own = np.array([0.0 if task == "Relax" else 1.0] * 9 + [0.0] * 2)
    name = f"ArmPerturb/{task}-v1"
    return {"trained policy": ap.trained_policy(name), "own action": lambda seen: np.tile(own, (len(seen), 1))}


def record(task, agent, given):
    return ap.record_agent(f"ArmPerturb/{task}-v1", agent, given, engine="compiled")


def film(task, folder):
    start, stop, slow = FILMS[task]
    pulse = ap.Pulse(peak=107.8, direction_deg=20.0, onset=1.0, duration=2.0)
    given = [ap.Trial(subject=subject(task), perturbation=pulse)] if task == "Pulse" else trials(task, subject(task))
    replay = Replay.of_trial(record(task, agents(task)["trained policy"], given), 0)
    clip = Clip(view="oblique", size=(320, 240), start=start, stop=stop, slow=slow)
    ap.write_video(replay, folder / f"agent_{task.lower()}.gif", clip)


def admittance_of(recording):
    """Frequencies [Hz] and admittance [m/N] up to where `compare` looks."""
    estimate = ap.response(recording, window_start=WINDOW_START)
    chosen = estimate.frequency <= HIGHEST
    return estimate.frequency[chosen], estimate.response[chosen]


def low_frequency_stiffness(recording):
    """Stiffness at the hand [N/m], as `compare` finds it."""
    return impedance_matrices(*admittance_of(recording))["stiffness"]


def outline(stiffness):
    """Force [N] against a displacement of 1 m in each direction."""
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    return (stiffness + stiffness.T) / 2.0 @ [np.cos(angle), np.sin(angle)]


@in_style()
def main(folder):
    folder.mkdir(parents=True, exist_ok=True)
    for task in FILMS:
        film(task, folder)
    figure = new_figure(5.4)
    for task, axes in zip(FORCE, figure.subplots(2, 3), strict=True):
        person, colours = subject(task), {"trained policy": COLOURS[subject(task).task], "own action": PALETTE[2]}
        recordings = {name: record(task, agent, trials(task, person)) for name, agent in agents(task).items()}
        likeness = ap.compare(recordings["trained policy"], "people", ideal=True)
        far = [f"{group} {value:.1f} ({likeness.usual[group]:.1f})" for group, value in likeness.distance.items()]
        print(task, ", ".join(far), flush=True)
        for k, ax in enumerate(axes[:2]):
            low, high = 1e3 * np.quantile(likeness.reference_gains[..., k], (0.025, 0.975), axis=0)
            ax.fill_between(likeness.frequency, low, high, color=PALE, linewidth=0, label=f"{N_PEOPLE} people, 95 %")
            for name, recording in recordings.items():
                frequency, admittance = admittance_of(recording)
                gains = 1e3 * np.linalg.svd(admittance, compute_uv=False)[:, k]
                ax.loglog(frequency, gains, color=colours[name], label=name)
            ax.set(xlabel="frequency [Hz]", title=f"{task}: {('largest', 'smallest')[k]} gain")
            ax.yaxis.set_minor_formatter(NullFormatter())
        axes[0].set_ylabel("admittance [mm/N]")
        axes[0].legend()
        ax = axes[2]
        for number in range(N_PEOPLE):
            entry = ap.draw_person(0, number).subjects[person.task]
            stiffness = low_frequency_stiffness(ap.run_experiment(trials(task, entry), engine="compiled"))
            ax.plot(*outline(stiffness), color=GREY, linewidth=0.5)
        for name, recording in recordings.items():
            stiffness = low_frequency_stiffness(recording)
            along, directions = np.linalg.eigh((stiffness + stiffness.T) / 2.0)
            angle = np.degrees(np.arctan2(*directions[::-1, 1])) % 180.0
            print(task, name, f"{along[1]:.0f} and {along[0]:.0f} N/m, the longer axis at {angle:.0f} deg", flush=True)
            ax.plot(*outline(stiffness), color=colours[name])
        ax.set(aspect="equal", xlabel="x [N/m]", ylabel="y [N/m]", title=f"{task}: stiffness at the hand")
        ax.title.set_color(INK)
    save_png(figure, folder / "agent_admittance.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
