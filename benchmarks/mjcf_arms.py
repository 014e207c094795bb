"""How well other people's arms are identified through `simulate --mjcf`: two links in MJCF whose parameters are known.

Run `python -m benchmarks.mjcf_arms --n 8`. Each arm (segments, springs and dampers over one and two joints, posture) is
drawn and written as MJCF; `armperturb simulate --mjcf` perturbs it with four multisines, as noisy instruments read
them, and the trials choose the structure by which it is identified. With `--remnant`, noise of a person who keeps
position acts at the joints, too, which only the Python interface can add. A line of JSON for each arm goes to `--out`
as soon as it is there; a second run with the same file continues. `--myoarm` instead times MyoArm (extra `myo`) and
says up to which force its displacement is a linear answer to the perturbation. `--human` compares it at three levels of
co-contraction with the thesis's arms and with people, as docs/laboratory.md has it.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import xarray as xr

import armperturb as ap
from armperturb.analysis.response.spectra import averaged_spectra
from armperturb.cli import main as command_line
from benchmarks.kept_rows import with_kept_rows

JUDGED = ("k_s", "k_se", "k_e", "b_s", "b_se", "b_e")
N_TRIALS, RATE, DURATION = 4, 200.0, 32.0

MJCF = """
<mujoco>
  <worldbody>
    <body name="upper" pos="0 0 1" euler="0 0 {theta_s}">
      <joint name="shoulder" axis="0 0 1"/>
      <inertial pos="{c_h} 0 0" mass="{m_h}" diaginertia="{i_h} {i_h} {i_h}"/>
      <body name="fore" pos="{l_h} 0 0" euler="0 0 {theta_e}">
        <joint name="elbow" axis="0 0 1"/>
        <inertial pos="{c_f} 0 0" mass="{m_f}" diaginertia="{i_f} {i_f} {i_f}"/>
        <site name="hand" pos="{l_f} 0 0"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="s" stiffness="{g_s}" damping="{d_s}"><joint joint="shoulder" coef="1"/></fixed>
    <fixed name="se" stiffness="{g_se}" damping="{d_se}">
      <joint joint="shoulder" coef="1"/><joint joint="elbow" coef="1"/>
    </fixed>
    <fixed name="e" stiffness="{g_e}" damping="{d_e}"><joint joint="elbow" coef="1"/></fixed>
  </tendon>
</mujoco>
"""


def draw(seed: int) -> tuple[dict[str, float], dict[str, float]]:
    """Numbers of the MJCF, and the joint stiffness [Nm/rad] and damping [Nms/rad] that they mean."""
    rng = np.random.default_rng(seed)
    ranges = {"theta_s": (20, 70), "theta_e": (60, 120), "l_h": (0.27, 0.35), "l_f": (0.3, 0.38)}
    ranges |= {"m_h": (1.4, 2.6), "m_f": (1.0, 1.9), "g_s": (25, 90), "g_se": (8, 35), "g_e": (20, 70)}
    ranges |= {"d_s": (0.8, 2.5), "d_se": (0.3, 1.0), "d_e": (0.6, 2.0)}
    arm = {name: float(np.round(rng.uniform(*ends), 4)) for name, ends in ranges.items()}
    for segment in ("h", "f"):
        length = arm[f"l_{segment}"]
        arm[f"c_{segment}"] = 0.45 * length
        arm[f"i_{segment}"] = arm[f"m_{segment}"] * (0.3 * length) ** 2
    truth = {}
    for quantity, group in (("k", "g"), ("b", "d")):
        shoulder, both, elbow = (arm[f"{group}_{name}"] for name in ("s", "se", "e"))
        truth |= {f"{quantity}_s": shoulder + both, f"{quantity}_se": both, f"{quantity}_e": elbow + both}
    return arm, truth


class Remnant:
    """Torque of a person's noise at the joints, as the laboratory's `controller`."""

    def __init__(self, load: float, seed: int) -> None:
        """Choose the noise.

        Args:
          load: RMS torque with which the perturbation loads each joint [Nm].
          seed: of the noise.
        """
        self._load, self._seed = load, seed

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> Callable[[], None]:
        """Begin a trial."""
        rng, n_steps = np.random.default_rng(self._seed), round(1.1 * DURATION / model.opt.timestep)
        torque = iter(ap.HUMAN_NOISE["PT"].torque(np.full(2, self._load), model.opt.timestep, n_steps, rng))
        joints = [model.joint(name).dofadr[0] for name in ("shoulder", "elbow")]

        def step() -> None:
            data.qfrc_applied[joints] = next(torque)

        return step


def record(model: Path, push: ap.Multisine, seed: int, with_remnant: bool) -> xr.Dataset:
    """One trial of an arm."""
    if with_remnant:
        controller = Remnant(0.35 * push.rms, seed)
        return ap.Laboratory(model, "hand", controller=controller).record(
            [push], seed=seed, instruments=ap.Instruments()
        )
    force, out = model.with_name(f"{seed}.csv"), model.with_name(f"{seed}.nc")
    ap.save_perturbation(push, force, RATE)
    options = ["--perturbation", force, "--out", out, "--mjcf", model, "--hand", "hand", "--seed", seed]
    command_line(["simulate", *map(str, options)])
    return ap.load_recording(out)


def judge(seed: int, rms: float, remnant: bool) -> dict:
    """Draw, perturb and identify one arm."""
    arm, truth = draw(seed)
    row: dict = {"seed": seed}
    with tempfile.TemporaryDirectory() as name:
        model = Path(name) / "arm.xml"
        model.write_text(MJCF.format(**arm), encoding="utf-8")
        start = time.process_time()
        seeds = range(N_TRIALS * seed, N_TRIALS * (seed + 1))
        pushes = [ap.Multisine.draw(seed=each, rms=rms, duration=DURATION) for each in seeds]
        recordings = [record(model, push, each, remnant) for push, each in zip(pushes, seeds, strict=True)]
        row["simulated"] = time.process_time() - start
        start = time.process_time()
        result = ap.identify(ap.stack_trials(recordings))
        row["identified"] = time.process_time() - start
    fit, detail = result.fit, result.fit.detail
    for name in JUDGED:
        low, high = fit.interval(name)
        inside = bool(low <= truth[name] <= high)
        row[name] = [truth[name], fit.values[name], fit.standard_error[name], inside]
    row |= {"chosen": list(fit.choice.chosen[:3]), "right": tuple(fit.choice.chosen[:3]) == ("free", "spring", "none")}
    return row | {"chi2/dof": detail.chi2 / detail.dof, "suspicious": detail.is_suspicious}


def report(rows: list[dict]) -> None:
    """Print what was found."""
    for row in rows:
        values = "  ".join(f"{name} {row[name][1]:.3g} ({row[name][0]:.3g})" for name in JUDGED)
        print(f"{row['seed']:4}  {'/'.join(row['chosen'])}  chi2/dof {row['chi2/dof']:.2f}  {values}")
    values = np.array([[row[name] for name in JUDGED] for row in rows])
    truth, outcome, error, inside = np.moveaxis(values.astype(float), 2, 0)
    print(f"{len(rows)} arms: structure right {100.0 * np.mean([row['right'] for row in rows]):.0f} %")
    print(f"inside 95 %: {100.0 * inside.mean():.1f} %, worst parameter {100.0 * inside.mean(axis=0).min():.1f} %")
    off = 100.0 * np.abs(outcome / truth - 1.0)
    print(
        f"off by {np.median(off):.2f} % (median), at most {off.max():.1f} %; error over standard error (RMS) ", end=""
    )
    print(f"{np.sqrt(np.mean(((outcome - truth) / error) ** 2)):.2f}, which is {np.median(error / truth):.2%} (median)")
    misfit = np.median([row["chi2/dof"] for row in rows])
    print(f"chi2/dof {misfit:.2f} (median), {sum(row['suspicious'] for row in rows)} flagged")
    times = [f"{np.median([row[name] for row in rows]):.1f} s {name}" for name in ("simulated", "identified")]
    print(f"processor time of an arm: {', '.join(times)}")


def around_myoarm(activation: float, **options: Any) -> ap.Laboratory:
    """The laboratory around MyoArm, whose elbow is bent by a right angle and whose wrist and fingers are held."""
    posture = {"shoulder_elv_r": 80.0, "elv_angle_r": 45.0, "shoulder_rot_r": 45.0, "elbow_flexion_r": 90.0}
    cuffed = ("pro_sup_r", "deviation_r", "flexion_r", "cmc*", "mp_*", "ip_*", "mcp*", "pm*", "md*")
    return ap.Laboratory(
        "myo_sim:myoarm_r", "3proxph_r", activation=activation, posture_deg=posture, locked=cuffed, **options
    )


def human() -> None:
    """Distance of MyoArm from people who keep position, under one multisine of 1 N."""
    for level in (0.02, 0.1, 0.4):
        laboratory = around_myoarm(level, joints=("elv_angle_r", "elbow_flexion_r"), turn_deg=180.0)
        recording = laboratory.record([ap.Multisine.draw(rms=1.0, seed=0)])
        for reference in ("thesis", "people"):
            outcome = ap.compare(recording, reference, ideal=True)
            size = outcome.to_frame().set_index("quantity").loc["stiffness: size"]
            distances = [
                f"{name} {outcome.distance[name]:.1f} ({outcome.usual[name]:.1f})" for name in outcome.distance
            ]
            stiffness = f"stiffness {np.exp(size['value']):.0f} N/m, theirs {np.exp(size['mean']):.0f}"
            print(f"co-contraction {level:g}, {reference}: {', '.join(distances)}; {stiffness}", flush=True)


def myoarm() -> None:
    """Time of a trial of 32 s of MyoArm, and its multiple coherence below 10 Hz, at several forces."""
    start = time.process_time()
    laboratory = around_myoarm(0.1)
    print(f"MyoArm comes to rest in {time.process_time() - start:.1f} s of processor time")
    for rms in (0.3, 1.0, 3.0):
        pushes = [ap.Multisine.draw(seed=seed, rms=rms, duration=DURATION) for seed in range(N_TRIALS)]
        start = time.process_time()
        recording = laboratory.record(pushes, instruments=ap.Instruments(emg=None))
        took = (time.process_time() - start) / N_TRIALS
        estimate = averaged_spectra(recording, window_start=8.0)
        coherence = estimate.coherence[estimate.frequency < 10.0]
        moved = 1e3 * recording["displacement"].values.std()
        least, typical = coherence.min(axis=0), np.median(coherence, axis=0)
        print(f"{rms:g} N, {moved:.1f} mm: {took:.1f} s a trial; coherence of x and y below 10 Hz ", end="")
        print(f"{typical[0]:.3f} and {typical[1]:.3f} (median), {least[0]:.3f} and {least[1]:.3f} (least)")


def main() -> None:
    """Identify the arms that are not in the file yet, and report on all that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=8, help="arms")
    parser.add_argument("--seed", type=int, default=0, help="of the first arm; the others follow")
    parser.add_argument("--rms", type=float, default=1.0, help="force of the multisines per axis [N]")
    parser.add_argument("--remnant", action="store_true", help="a person's noise at the joints")
    parser.add_argument("--out", type=Path, help="file of JSON lines")
    parser.add_argument("--myoarm", action="store_true", help="MyoArm, in the place of two links")
    parser.add_argument("--human", action="store_true", help="how far MyoArm is from people")
    asked = parser.parse_args()
    if asked.myoarm or asked.human:
        (myoarm if asked.myoarm else human)()
        return
    seeds = range(asked.seed, asked.seed + asked.n)
    of_all = {"rms": asked.rms, "remnant": asked.remnant}
    report(with_kept_rows(asked.out, seeds, lambda left: (judge(seed, **of_all) for seed in left), **of_all))


if __name__ == "__main__":
    main()
