"""How do I run a study that one machine is too slow for? On a Dask cluster, here a local one, with 1,000 people.

Run `python examples/thousand_subjects.py FOLDER [--subjects 1000] [--workers 4] [--protocol FILE.toml]`; it needs
`pip install 'armperturb[dask]'`. Stopped or killed, the same command goes on. For a real cluster take the address of
its scheduler, as in `armperturb study --out FOLDER --subjects 1000 --record-only --dask tcp://HOST:8786`: its workers
need armperturb in the same version, but no common file system, as they send the files back.
"""

import argparse
import os
from pathlib import Path

from distributed import LocalCluster

from armperturb.study.recording.record import record_study
from armperturb.study.recording.settings import StudySettings


def main(arguments: list[str] | None = None) -> list[Path]:
    parser = argparse.ArgumentParser(description="Record a large study on a local Dask cluster.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--subjects", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--protocol", type=Path, default=None)
    options = parser.parse_args(arguments)
    settings = StudySettings(subjects=options.subjects, protocol=options.protocol)
    # One thread per process: a unit of work keeps it busy. Memory is bounded by the block, not by the study.
    with LocalCluster(n_workers=options.workers, threads_per_worker=1, dashboard_address=":0") as cluster:
        files = record_study(settings, options.folder, dask=cluster.scheduler_address, block=32)
    size = sum(path.stat().st_size for path in files)
    print(f"{len(files)} recordings, {size / 1e6:.1f} MB, in {options.folder / 'recordings'}")
    return files


if __name__ == "__main__":
    main()
