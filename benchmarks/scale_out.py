"""What a cohort costs that is simulated, practises and is measured: time, processor time and memory against people.

Run `python -m benchmarks.scale_out [--people N ...] [--dask] [--picture FILE.png]`; some four minutes per 1,000 people
on two cores. Each size is run in a process of its own, so that memory is its own. Targets: 1,000 people x 32 trials of
36 s in at most 6 min on 2 cores with less than 1 GiB, and memory that does not grow with people. `--dask` runs them on
a local Dask cluster of as many workers as there are cores.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from armperturb.study.experiments.cohort_cells import measure_cohort
from armperturb.study.recording.settings import StudySettings
from benchmarks.study_speed import Memory, processor_time

PEOPLE = (10, 30, 100, 300, 1000)
COSTS = {"wall": "wall time [s]", "processor": "processor time [s]", "memory": "memory [MiB]"}


def cost(people: int, dask: bool) -> dict[str, float]:
    """Of one cohort, in this process."""
    settings = StudySettings(subjects=people, engine="compiled")
    memory = Memory()
    memory.start()
    start = time.perf_counter()
    if dask:
        from distributed import LocalCluster

        options = {"n_workers": os.cpu_count(), "threads_per_worker": 1, "dashboard_address": None}
        with LocalCluster(**options) as cluster:
            cells = measure_cohort(settings, dask=cluster.scheduler_address, show_progress=False)
    else:
        cells = measure_cohort(settings, show_progress=False)
    took = time.perf_counter() - start
    memory.stop()
    assert len(cells) == people
    spent = processor_time() - memory.processor_time
    return {"people": people, "wall": took, "processor": spent, "memory": memory.peak / 2**20}


def cost_alone(people: int, *, dask: bool = False) -> dict[str, float]:
    """The same in a process of its own, which holds nothing else."""
    command = [sys.executable, "-m", "benchmarks.scale_out", "--alone", "--people", str(people)]
    run = subprocess.run(command + ["--dask"] * dask, check=True, capture_output=True, text=True)
    return dict(json.loads(run.stdout.splitlines()[-1]))


def draw(costs: list[dict[str, float]], picture: Path) -> None:
    """Each cost against people."""
    import matplotlib.pyplot as plt  # not above: the processes that are measured draw nothing

    from armperturb.plots.style import save_png

    figure, axes = plt.subplots(1, 3, figsize=(9.0, 2.8), layout="constrained")
    for ax, (name, label) in zip(axes, COSTS.items(), strict=True):
        values = [each[name] for each in costs]
        ax.plot([each["people"] for each in costs], values, "o-", markersize=4)
        ax.set(xscale="log", xlabel="people", ylabel=label)
        if name == "memory":
            ax.set_ylim(0.0, 1.3 * max(values))
        else:
            ax.set(yscale="log", ylim=(3.0, 1000.0 * 10.0 ** (max(values) > 1000.0)))
    save_png(figure, picture, 110.0)


def main(arguments: list[str] | None = None) -> None:
    """Print the costs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--people", type=int, nargs="+", default=PEOPLE)
    parser.add_argument("--dask", action="store_true")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--alone", action="store_true", help="one size in this process, as JSON")
    options = parser.parse_args([] if arguments is None else arguments)
    if options.alone:
        print(json.dumps(cost(options.people[0], options.dask)))
        return
    costs = []
    for people in options.people:
        costs.append(each := cost_alone(people, dask=options.dask))
        print(
            f"{people:6d} people: {each['wall']:6.1f} s wall on {os.cpu_count()} cores, {each['processor']:6.1f} s of "
            f"processor time ({1e3 * each['processor'] / people:.0f} ms a person), {each['memory']:.0f} MiB",
            flush=True,
        )
    print("target for 1,000 people: 360 s on 2 cores, 1024 MiB")
    if options.picture:
        draw(costs, options.picture)


if __name__ == "__main__":
    main(sys.argv[1:])
