"""Run as a program: reads all of an HDF5 file, and says on standard output how large its arrays are.

A process of its own, and one that needs nothing of this package: damaged files make HDF5 crash or go on for ever.
"""

import json
import sys

import h5py


def sizes(path: str) -> dict[str, int]:
    """Name of an array to what it unpacks to [byte]."""
    claims: dict[str, int] = {}

    def count(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            claims[name] = int(item.size or 0) * item.dtype.itemsize

    with h5py.File(path) as file:
        file.visititems(count)
    return claims


def read(path: str) -> None:
    """Read everything as the readers of MATLAB and netCDF files do."""

    def touch(_: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            item[()]
        if isinstance(item, h5py.Dataset | h5py.Group):
            dict(item.attrs)

    with h5py.File(path) as file:
        touch("", file)
        file.visititems(touch)
    if not path.endswith(".mat"):
        import h5netcdf

        with h5netcdf.File(path) as recording:
            for variable in recording.variables.values():
                _ = variable.dimensions, dict(variable.attrs), variable[...]


if __name__ == "__main__":
    try:
        found = sizes(sys.argv[1])
        if sum(found.values()) <= int(sys.argv[2]):
            read(sys.argv[1])
    except Exception as error:
        sys.exit(" ".join(f"{error}".split()) or type(error).__name__)
    sys.stdout.write(json.dumps(found))
